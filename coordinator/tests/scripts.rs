//! Scheduling as stories: each file in `tests/scripts` tells what happens, and after each line,
//! behind `>`, what was decided. `BLESS=1` writes what is decided now into the files, to be read in
//! the diff.
//!
//! - `submit infer:a fuse:b<a` submits jobs; `b` needs `a`.
//! - `w1 reports 1 infer 0 fuse; holds a#1 running, b#2; done c#1; failed d#1 retryable counts` is a
//!   report and the wish for as many jobs; all parts but the slots may be left out, `draining` may
//!   be added, and `while w2 w3 wait`. `w1@a` is a worker on host a; without that all are on one.
//! - `clock +7s` lets time pass; `cancel a b`, `lost a b` and `restart` (of the coordinator) do as
//!   they say.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use planesweep_coordinator::schedule::{
    Class, Command, Ending, Event, Finished, FreeSlots, Held, JobRecord, JobShape, LedgerState, Snapshot,
    Timestamp, decide,
};
use planesweep_plan::{Attempt, JobId, WorkerId};

const LEASE_MS: u64 = 7000;

struct Story {
    snapshot: Snapshot,
    now: Timestamp,
    /// The ledger, as far as a restart needs it.
    ledger: BTreeMap<JobId, JobRecord>,
    order: Vec<JobId>,
}

impl Story {
    fn new() -> Self {
        let now = Timestamp(0);
        Self { snapshot: Snapshot::new(LEASE_MS, [], now), now, ledger: BTreeMap::new(), order: Vec::new() }
    }

    fn tell(&mut self, line: &str) -> Vec<String> {
        let (verb, rest) = line.split_once(' ').unwrap_or((line, ""));
        match verb {
            "submit" => {
                let event = Event::Submitted { jobs: rest.split_whitespace().map(shape).collect() };
                self.happen(event)
            }
            "cancel" => self.happen(Event::Cancelled { jobs: rest.split_whitespace().map(job).collect() }),
            "lost" => self.happen(Event::ResultsLost { jobs: rest.split_whitespace().map(job).collect() }),
            "clock" => {
                let seconds = rest.trim_start_matches('+').trim_end_matches('s');
                let seconds: f64 = seconds.parse().expect("a number of seconds");
                self.now = self.now.plus((seconds * 1000.0) as u64);
                self.happen(Event::Tick)
            }
            "restart" => {
                let records = self.order.iter().map(|job| self.ledger[job].clone());
                self.snapshot = Snapshot::new(LEASE_MS, records, self.now);
                Vec::new()
            }
            worker => {
                let (worker, host) = worker.split_once('@').unwrap_or((worker, "host"));
                self.report(WorkerId(worker.to_owned()), host.to_owned(), rest)
            }
        }
    }

    fn report(&mut self, worker: WorkerId, host: String, text: &str) -> Vec<String> {
        let (mut held, mut finished, mut ready) = (Vec::new(), Vec::new(), true);
        let (mut free, mut waiting) = (FreeSlots::default(), Vec::new());
        for part in text.split(';').map(str::trim) {
            let words: Vec<&str> = part.split_whitespace().collect();
            match words.as_slice() {
                ["reports", infer, "infer", fuse, "fuse"] => {
                    free.infer = infer.parse().expect("slots");
                    free.fuse = fuse.parse().expect("slots");
                }
                ["draining"] => ready = false,
                ["while", workers @ .., "wait"] => {
                    waiting = workers.iter().map(|worker| WorkerId((*worker).to_owned())).collect();
                }
                ["holds", ..] => {
                    held = part["holds".len()..].split(',').map(|text| held_job(text.trim())).collect();
                }
                ["done", jobs @ ..] => {
                    finished.extend(jobs.iter().map(|text| {
                        let (job, attempt) = tried(text);
                        Finished { job, attempt, ending: Ending::Success }
                    }));
                }
                ["failed", text, how @ ..] => {
                    let (job, attempt) = tried(text);
                    let lost = how.iter().skip_while(|word| **word != "lost").skip(1);
                    let ending = Ending::Failure {
                        retryable: how.contains(&"retryable"),
                        counts: how.contains(&"counts"),
                        lost: lost.map(|text| self::job(text)).collect(),
                    };
                    finished.push(Finished { job, attempt, ending });
                }
                _ => panic!("no such part of a report: {part}"),
            }
        }
        let mut lines = self.happen(Event::Reported { worker: worker.clone(), host, ready, held, finished });
        lines.extend(self.happen(Event::WantsWork { worker, free, waiting }));
        lines
    }

    fn happen(&mut self, event: Event) -> Vec<String> {
        let mut lines = Vec::new();
        for command in decide(&self.snapshot, event, self.now) {
            let late = if self.snapshot.apply(&command, self.now) { "" } else { " (too late)" };
            self.record(&command);
            if let Some(line) = describe(&command) {
                lines.push(format!("> {line}{late}"));
            }
        }
        lines
    }

    fn record(&mut self, command: &Command) {
        let mut set = |job: &JobId, state| {
            self.ledger.get_mut(job).expect("a known job").state = state;
        };
        match command {
            Command::Insert { shape } => {
                self.order.push(shape.id);
                self.ledger.insert(shape.id, JobRecord::new(shape.clone()));
            }
            Command::Grant { job, attempt, worker, .. } => {
                set(job, LedgerState::Leased(worker.clone()));
                self.ledger.get_mut(job).expect("a known job").attempt = *attempt;
            }
            Command::Complete { job, .. } => set(job, LedgerState::Done),
            Command::GiveUp { job, .. } => set(job, LedgerState::Failed),
            Command::Retry { job, .. } | Command::Release { job, .. } | Command::Reopen { job, .. } => {
                set(job, LedgerState::Open);
            }
            Command::Suspect { job, deaths_alone, .. } => {
                set(job, LedgerState::Open);
                let record = self.ledger.get_mut(job).expect("a known job");
                (record.suspect, record.deaths_alone) = (true, *deaths_alone);
            }
            _ => {}
        }
    }
}

fn job(name: &str) -> JobId {
    let mut id = [0; 32];
    id[..name.len()].copy_from_slice(name.as_bytes());
    JobId(id)
}

fn name(job: &JobId) -> String {
    String::from_utf8(job.0.iter().copied().take_while(|byte| *byte != 0).collect()).expect("a name")
}

fn shape(text: &str) -> JobShape {
    let (kind, rest) = text.split_once(':').expect("kind:name");
    let (id, needs) = rest.split_once('<').unwrap_or((rest, ""));
    let needs = needs.split(',').filter(|need| !need.is_empty()).map(job).collect();
    JobShape { id: job(id), class: Class::of(kind), needs }
}

fn tried(text: &str) -> (JobId, Attempt) {
    let (name, attempt) = text.split_once('#').expect("job#attempt");
    (job(name), Attempt(attempt.parse().expect("a number")))
}

fn held_job(text: &str) -> Held {
    let (text, started) = text.strip_suffix(" running").map_or((text, false), |text| (text, true));
    let (job, attempt) = tried(text);
    Held { job, attempt, started }
}

fn describe(command: &Command) -> Option<String> {
    Some(match command {
        Command::Insert { .. } | Command::Admit { .. } => return None,
        Command::Reopen { job, why } => format!("reopen {} ({why:?})", name(job)),
        Command::Renew { job, attempt, deadline, .. } => {
            format!("renew {}#{attempt} until {deadline}", name(job))
        }
        Command::Grant { job, attempt, worker, deadline } => {
            format!("grant {}#{attempt} to {worker} until {deadline}", name(job))
        }
        Command::Complete { job, attempt, worker } => format!("complete {}#{attempt} by {worker}", name(job)),
        Command::Retry { job, attempt, failures, losses, until } => {
            let losses = if *losses > 0 { format!(", losses {losses}") } else { String::new() };
            format!("retry {}#{attempt} not before {until}, failures {failures}{losses}", name(job))
        }
        Command::GiveUp { job, attempt, quarantined } => {
            let how = if *quarantined { "quarantine" } else { "give up" };
            format!("{how} {}#{attempt}", name(job))
        }
        Command::Release { job, attempt } => format!("release {}#{attempt}", name(job)),
        Command::Suspect { job, attempt, deaths_alone } => {
            format!("suspect {}#{attempt}, deaths alone {deaths_alone}", name(job))
        }
        Command::Cancel { job } => format!("cancel {}", name(job)),
        Command::Dismiss { worker } => format!("dismiss {worker}"),
        Command::Revoke { job, attempt } => format!("revoke {}#{attempt}", name(job)),
        Command::Acknowledge { job, attempt } => format!("acknowledge {}#{attempt}", name(job)),
        Command::CountLate { job, attempt } => format!("late {}#{attempt}", name(job)),
    })
}

fn retell(script: &str) -> String {
    let mut story = Story::new();
    let mut told = String::new();
    for line in script.lines().filter(|line| !line.starts_with('>')) {
        told.push_str(line);
        told.push('\n');
        if !line.trim().is_empty() && !line.starts_with('#') {
            for decided in story.tell(line) {
                told.push_str(&decided);
                told.push('\n');
            }
        }
    }
    told
}

#[test]
fn stories_end_as_written() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scripts");
    let mut stories = 0;
    for entry in fs::read_dir(&folder).expect("the folder of scripts") {
        let path = entry.expect("an entry").path();
        let script = fs::read_to_string(&path).expect("a script");
        let told = retell(&script);
        if std::env::var_os("BLESS").is_some() {
            fs::write(&path, &told).expect("a writable script");
            continue;
        }
        assert_eq!(told, script, "{} tells another story now", path.display());
        stories += 1;
    }
    assert!(
        std::env::var_os("BLESS").is_some() || stories >= 5,
        "only {stories} scripts in {}",
        folder.display()
    );
}
