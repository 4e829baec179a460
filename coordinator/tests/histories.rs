//! Random histories of workers, messages and time against a model of the ledger that is as plain as
//! its SQL: after each event the invariants of `schedule` hold, and at the end every job that a run
//! wants has ended.

use std::collections::{BTreeMap, BTreeSet};

use planesweep_coordinator::schedule::{
    Class, Command, Ending, Event, Finished, FreeSlots, Held, JobRecord, JobShape, LedgerState,
    MAX_DEATHS_ALONE, MAX_FAILURES, MAX_LOSSES, Reopening, Snapshot, Timestamp, check_order, decide,
};
use planesweep_plan::{Attempt, JobId, WorkerId};
use proptest::collection::vec;
use proptest::prelude::*;

const LEASE_MS: u64 = 7000;

/// Ids come from content: inference is the same in plans of any size, all else is not.
fn id(kind: u8, view: usize, views: usize) -> JobId {
    let mut id = [0; 32];
    (id[0], id[1]) = (kind, view as u8);
    id[2] = if kind == 0 { 0 } else { views as u8 };
    JobId(id)
}

/// Infer, filter and emit of each view with its two neighbours, and the cloud.
fn plan(views: usize) -> Vec<JobShape> {
    let around = |kind, view: usize| (0..views.min(3)).map(|k| id(kind, (view + k) % views, views)).collect();
    let mut jobs: Vec<JobShape> = (0..views)
        .map(|view| JobShape { id: id(0, view, views), class: Class::Infer, needs: vec![] })
        .collect();
    for kind in [1, 2] {
        jobs.extend((0..views).map(|view| JobShape {
            id: id(kind, view, views),
            class: Class::Fuse,
            needs: around(kind - 1, view),
        }));
    }
    let needs = (0..views).map(|view| id(2, view, views)).collect();
    jobs.push(JobShape { id: id(3, 0, views), class: Class::Fuse, needs });
    jobs
}

/// What one try of a job reads: for each need, whether it had a result, and which.
type Version = u64;

#[derive(Default)]
struct Ledger {
    jobs: BTreeMap<JobId, JobRecord>,
    order: Vec<JobId>,
    /// Hash-like value of each result: determined by the job and by the inputs it had.
    published: BTreeMap<JobId, Version>,
    /// What the try that holds the lease will produce.
    computing: BTreeMap<(JobId, Attempt), Version>,
    highest: BTreeMap<JobId, Attempt>,
    late: u64,
}

impl Ledger {
    /// The statement of a command; whether a row changed.
    fn execute(&mut self, command: &Command) -> bool {
        let leased = |ledger: &Self, job: &JobId, attempt: &Attempt| {
            let job = &ledger.jobs[job];
            job.attempt == *attempt && matches!(job.state, LedgerState::Leased(_))
        };
        match command {
            Command::Insert { shape } => {
                self.order.push(shape.id);
                self.jobs.insert(shape.id, JobRecord::new(shape.clone())).is_none()
            }
            Command::Reopen { job: id, why } => {
                let job = self.jobs.get_mut(id).expect("a known job");
                let allowed = match why {
                    Reopening::Resubmitted => {
                        matches!(job.state, LedgerState::Failed | LedgerState::Cancelled)
                    }
                    Reopening::ResultLost => job.state == LedgerState::Done,
                    Reopening::NewInput => matches!(job.state, LedgerState::Done | LedgerState::Leased(_)),
                };
                job.outdated |= *why == Reopening::NewInput;
                if allowed {
                    job.state = LedgerState::Open;
                    (job.failures, job.losses, job.suspect, job.deaths_alone) = (0, 0, false, 0);
                    self.published.remove(id);
                }
                allowed || *why == Reopening::NewInput
            }
            Command::Renew { job, attempt, worker, .. } => {
                leased(self, job, attempt) && self.jobs[job].state == LedgerState::Leased(worker.clone())
            }
            Command::Grant { job, attempt, worker, .. } => self.grant(*job, *attempt, worker),
            Command::Complete { job: id, attempt, worker } => {
                let holds =
                    leased(self, id, attempt) && self.jobs[id].state == LedgerState::Leased(worker.clone());
                if holds {
                    self.published.insert(*id, self.computing[&(*id, *attempt)]);
                    let job = self.jobs.get_mut(id).expect("a known job");
                    job.state = LedgerState::Done;
                    job.outdated = false;
                    (job.failures, job.losses, job.suspect, job.deaths_alone) = (0, 0, false, 0);
                }
                holds
            }
            Command::GiveUp { job: id, attempt, .. } => {
                let holds = leased(self, id, attempt);
                if holds {
                    let job = self.jobs.get_mut(id).expect("a known job");
                    job.state = LedgerState::Failed;
                    job.outdated = true;
                    (job.failures, job.losses, job.suspect, job.deaths_alone) = (0, 0, false, 0);
                }
                holds
            }
            Command::Retry { job, attempt, .. }
            | Command::Release { job, attempt }
            | Command::Suspect { job, attempt, .. } => {
                let holds = leased(self, job, attempt);
                if holds {
                    let job = self.jobs.get_mut(job).expect("a known job");
                    job.state = LedgerState::Open;
                    match command {
                        Command::Retry { failures, losses, .. } => {
                            assert!(*failures < MAX_FAILURES, "too many tries");
                            assert!(*losses < MAX_LOSSES, "too many losses");
                            (job.failures, job.losses) = (*failures, *losses);
                        }
                        Command::Suspect { deaths_alone, .. } => {
                            assert!(*deaths_alone < MAX_DEATHS_ALONE, "too many deaths");
                            (job.suspect, job.deaths_alone) = (true, *deaths_alone);
                        }
                        _ => {}
                    }
                }
                holds
            }
            Command::Cancel { job } => {
                let job = self.jobs.get_mut(job).expect("a known job");
                let was = matches!(job.state, LedgerState::Open | LedgerState::Leased(_));
                if was {
                    job.state = LedgerState::Cancelled;
                }
                was
            }
            Command::CountLate { .. } => {
                self.late += 1;
                true
            }
            _ => true,
        }
    }

    fn grant(&mut self, id: JobId, attempt: Attempt, worker: &WorkerId) -> bool {
        let job = &self.jobs[&id];
        let ended = |need: &JobId| matches!(self.jobs[need].state, LedgerState::Done | LedgerState::Failed);
        assert!(job.shape.needs.iter().all(ended), "granted before its needs ended");
        assert_eq!(job.state, LedgerState::Open, "granted while not open");
        assert!(self.highest.get(&id) < Some(&attempt), "attempts rise");
        self.computing.insert((id, attempt), self.version(&job.shape));
        self.highest.insert(id, attempt);
        let job = self.jobs.get_mut(&id).expect("a known job");
        (job.state, job.attempt) = (LedgerState::Leased(worker.clone()), attempt);
        true
    }

    /// What the job gives with the inputs that there are now.
    fn version(&self, shape: &JobShape) -> Version {
        let inputs = shape.needs.iter().map(|need| self.published.get(need).copied().unwrap_or(1));
        inputs.fold(u64::from(shape.id.0[0]) + 2, |hash, input| {
            (hash ^ input).wrapping_mul(0x100_0000_01b3).rotate_left(23)
        })
    }

    fn records(&self) -> Vec<JobRecord> {
        self.order.iter().map(|job| self.jobs[job].clone()).collect()
    }
}

#[derive(Clone, Debug, Default)]
struct Worker {
    name: String,
    held: Vec<(JobId, Attempt)>,
    finished: Vec<Finished>,
}

#[derive(Clone, Debug)]
enum Step {
    /// A worker reports; its slots; whether the reply is lost.
    Report {
        worker: usize,
        slots: u32,
        reply_lost: bool,
    },
    /// A job that a worker holds ends.
    End {
        worker: usize,
        which: prop::sample::Index,
        ending: Ending,
        lost: bool,
    },
    /// A worker dies; a new one takes its place.
    Die {
        worker: usize,
    },
    Clock {
        ms: u64,
    },
    Submit {
        views: usize,
    },
    Cancel {
        views: usize,
    },
    Lose {
        job: prop::sample::Index,
    },
    Restart,
    /// From now on the other coordinator of the same ledger is the one that is spoken to.
    Switch,
}

fn step() -> impl Strategy<Value = Step> {
    let ending = prop_oneof![
        6 => Just(Ending::Success),
        2 => (any::<bool>(), any::<bool>())
            .prop_map(|(retryable, counts)| Ending::Failure { retryable, counts, lost: vec![] }),
    ];
    prop_oneof![
        12 => (0..3_usize, 0..3_u32, prop::bool::weighted(0.2))
            .prop_map(|(worker, slots, reply_lost)| Step::Report { worker, slots, reply_lost }),
        12 => (0..3_usize, any::<prop::sample::Index>(), ending, prop::bool::weighted(0.05))
            .prop_map(|(worker, which, ending, lost)| Step::End { worker, which, ending, lost }),
        1 => (0..3_usize).prop_map(|worker| Step::Die { worker }),
        3 => (100..8000_u64).prop_map(|ms| Step::Clock { ms }),
        1 => (1..5_usize).prop_map(|views| Step::Submit { views }),
        1 => (1..5_usize).prop_map(|views| Step::Cancel { views }),
        1 => any::<prop::sample::Index>().prop_map(|job| Step::Lose { job }),
        1 => Just(Step::Restart),
        2 => Just(Step::Switch),
    ]
}

struct World {
    ledger: Ledger,
    snapshot: Snapshot,
    /// What another coordinator knew when it was last spoken to.
    other: Snapshot,
    /// When the leases end that the ledger has.
    deadlines: BTreeMap<JobId, Timestamp>,
    now: Timestamp,
    workers: Vec<Worker>,
    born: usize,
    /// The plans that are wanted, by their number of views.
    active: BTreeSet<usize>,
}

impl World {
    fn new() -> Self {
        let mut world = Self {
            ledger: Ledger::default(),
            snapshot: Snapshot::new(LEASE_MS, [], Timestamp(0)),
            other: Snapshot::new(LEASE_MS, [], Timestamp(0)),
            deadlines: BTreeMap::new(),
            now: Timestamp(0),
            workers: Vec::new(),
            born: 0,
            active: BTreeSet::new(),
        };
        for _ in 0..3 {
            let worker = world.newborn();
            world.workers.push(worker);
        }
        world
    }

    fn newborn(&mut self) -> Worker {
        self.born += 1;
        Worker { name: format!("w{}", self.born), ..Worker::default() }
    }

    /// Decides, carries out, and checks that snapshot and ledger agree on what changed.
    fn happen(&mut self, event: Event) -> Vec<Command> {
        let commands = decide(&self.snapshot, event, self.now);
        for command in &commands {
            let changed = self.ledger.execute(command);
            assert_eq!(self.snapshot.apply(command, self.now), changed, "{command:?}");
            if let Command::Grant { job, deadline, .. } | Command::Renew { job, deadline, .. } = command {
                self.deadlines.insert(*job, *deadline);
            }
        }
        self.check();
        commands
    }

    fn check(&self) {
        let mut leased = BTreeMap::new();
        for job in self.ledger.jobs.values() {
            if let LedgerState::Leased(worker) = &job.state {
                *leased.entry(worker.clone()).or_insert(0) += 1;
            }
            assert_eq!(self.snapshot.is_done(&job.shape.id), job.state == LedgerState::Done);
            assert_eq!(self.ledger.published.contains_key(&job.shape.id), job.state == LedgerState::Done);
        }
        let names = self.workers.iter().map(|worker| WorkerId(worker.name.clone()));
        let known: BTreeSet<WorkerId> = names.chain(leased.keys().cloned()).collect();
        for worker in known {
            assert_eq!(self.snapshot.held_by(&worker), leased.get(&worker).copied().unwrap_or(0), "{worker}");
        }
        assert_eq!(self.snapshot.len(), self.ledger.jobs.len());
    }

    fn report(&mut self, worker: usize, slots: u32, reply_lost: bool) {
        let Worker { name, held, finished } = self.workers[worker].clone();
        let id = WorkerId(name);
        let commands = self.happen(Event::Reported {
            worker: id.clone(),
            host: "host".to_owned(),
            ready: true,
            held: held.iter().map(|&(job, attempt)| Held { job, attempt, started: true }).collect(),
            finished,
        });
        let grants = self.happen(Event::WantsWork {
            worker: id,
            free: FreeSlots { infer: slots, fuse: slots },
            waiting: vec![],
        });
        assert!(grants.len() <= 2 * slots as usize, "no more than asked for");
        if reply_lost {
            return;
        }
        let worker = &mut self.workers[worker];
        for command in commands.into_iter().chain(grants) {
            match command {
                Command::Grant { job, attempt, .. } => worker.held.push((job, attempt)),
                Command::Revoke { job, attempt } => worker.held.retain(|held| *held != (job, attempt)),
                Command::Acknowledge { job, attempt } => {
                    worker.finished.retain(|f| (f.job, f.attempt) != (job, attempt));
                }
                _ => {}
            }
        }
    }

    fn end(&mut self, worker: usize, which: usize, ending: Ending) {
        let (job, attempt) = self.workers[worker].held.remove(which);
        self.workers[worker].finished.push(Finished { job, attempt, ending });
    }

    fn submit(&mut self, views: usize) {
        self.active.insert(views);
        self.happen(Event::Submitted { jobs: plan(views) });
    }

    fn pass(&mut self, ms: u64) {
        self.now = self.now.plus(ms);
        self.happen(Event::Tick);
    }

    fn go(&mut self, step: Step) {
        match step {
            Step::Report { worker, slots, reply_lost } => self.report(worker, slots, reply_lost),
            Step::End { worker, which, ending, lost } => {
                let held = self.workers[worker].held.len();
                if held == 0 {
                    return;
                }
                let which = which.index(held);
                let needs = self.snapshot.needs(&self.workers[worker].held[which].0);
                let ending = match needs.first() {
                    Some(need) if lost => {
                        Ending::Failure { retryable: true, counts: false, lost: vec![*need] }
                    }
                    _ => ending,
                };
                self.end(worker, which, ending);
            }
            Step::Die { worker } => self.workers[worker] = self.newborn(),
            Step::Clock { ms } => self.pass(ms),
            Step::Submit { views } => self.submit(views),
            Step::Cancel { views } => {
                self.active.remove(&views);
                let wanted: BTreeSet<JobId> =
                    self.active.iter().flat_map(|views| plan(*views)).map(|job| job.id).collect();
                let unwanted = self.ledger.order.iter().filter(|job| !wanted.contains(*job)).copied();
                let jobs = unwanted.collect();
                self.happen(Event::Cancelled { jobs });
            }
            Step::Lose { job } => {
                if !self.ledger.order.is_empty() {
                    let job = *job.get(&self.ledger.order);
                    self.happen(Event::ResultsLost { jobs: vec![job] });
                }
            }
            Step::Restart => {
                self.now = self.now.plus(10);
                self.snapshot = Snapshot::new(LEASE_MS, self.ledger.records(), self.now);
                self.check();
            }
            Step::Switch => {
                std::mem::swap(&mut self.snapshot, &mut self.other);
                for record in self.ledger.records() {
                    let deadline = self.deadlines.get(&record.shape.id).copied();
                    assert!(self.snapshot.observe(record, deadline, self.now));
                }
                self.check();
            }
        }
    }

    /// Workers live and everything they do succeeds: all jobs that a run wants end.
    fn calm_down(&mut self) {
        for round in 0.. {
            assert!(round < 400, "jobs are left that nobody does");
            for worker in 0..self.workers.len() {
                while !self.workers[worker].held.is_empty() {
                    self.end(worker, 0, Ending::Success);
                }
                self.report(worker, 2, false);
            }
            self.pass(2000);
            let idle = self.workers.iter().all(|worker| worker.held.is_empty() && worker.finished.is_empty());
            if idle && self.wanted_have_ended() {
                return;
            }
        }
    }

    /// What no run wants may be left open: when its result is lost, and what it needs was cancelled.
    fn wanted_have_ended(&self) -> bool {
        let mut wanted = self.active.iter().flat_map(|views| plan(*views));
        wanted
            .all(|shape| matches!(self.ledger.jobs[&shape.id].state, LedgerState::Done | LedgerState::Failed))
    }

    /// Each result of a plan was made of the newest results of what it needs.
    fn check_versions(&self, views: usize) {
        for shape in &plan(views) {
            let made = self.ledger.published[&shape.id];
            assert_eq!(made, self.ledger.version(shape), "{} was made of older inputs", shape.id);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn every_history_keeps_the_invariants_and_ends(views in 1..5_usize, steps in vec(step(), 0..120)) {
        check_order(&plan(views)).expect("a plan");
        let mut world = World::new();
        world.submit(views);
        for step in steps {
            world.go(step);
        }
        world.calm_down();
        // Once more, so that what failed or was cancelled gets its chance: now all is done.
        world.submit(views);
        world.calm_down();
        for job in plan(views) {
            prop_assert_eq!(&world.ledger.jobs[&job.id].state, &LedgerState::Done);
        }
        world.check_versions(views);
    }

    /// Crashes alone cost no job, however many there are.
    #[test]
    fn unrelated_crashes_cost_nothing(deaths in vec((0..3_usize, 0..6_u64), 0..3)) {
        let mut world = World::new();
        world.submit(4);
        for (worker, seconds) in deaths {
            world.report(worker, 1, false);
            world.workers[worker] = world.newborn();
            world.pass(seconds * 1000);
        }
        world.calm_down();
        prop_assert!(world.ledger.jobs.values().all(|job| job.state == LedgerState::Done));
    }
}
