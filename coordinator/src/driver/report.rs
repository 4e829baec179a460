//! Reports: recorded at once, answered at once or as soon as there is something to say.

use planesweep_plan::{Attempt, JobId, WorkerId};
use planesweep_proto::{
    Code, Failure, Grant, Input, JobAttempt, Order, Outcome, Peer, Report, ReportReply, ServiceError,
    WorkerState, with_causes,
};

use super::carry_out::Payload;
use super::message::Reply;
use super::peers::{Place, peers};
use super::{Driver, WorkerInfo};
use crate::ledger::{LedgerError, Step};
use crate::schedule::{Command, Ending, Event, Finished, FreeSlots, Held, Timestamp, decide};

/// A report whose reply is held back.
pub(super) struct Parked {
    free: FreeSlots,
    until: Timestamp,
    answer: ReportReply,
    reply: Reply<Result<ReportReply, ServiceError>>,
}

impl Driver {
    pub(super) async fn report(&mut self, report: Report, reply: Reply<Result<ReportReply, ServiceError>>) {
        let now = self.now();
        if let Some(last) = self.workers.get(&report.worker).filter(|info| info.sequence >= report.sequence) {
            let text =
                format!("report {} of {} came after {}", report.sequence, report.worker, last.sequence);
            let _ = reply.send(Err(ServiceError::new(Code::Superseded, text)));
            return;
        }
        if let Some(older) = self.parked.remove(&report.worker) {
            let _ = older.reply.send(Ok(older.answer));
        }
        self.workers.insert(
            report.worker.clone(),
            WorkerInfo {
                place: Place {
                    host: report.host.clone(),
                    boot_id: report.boot_id.clone(),
                    endpoint: report.endpoint.clone(),
                },
                role: report.role,
                device: report.device.clone(),
                state: report.state,
                last_report: now,
                sequence: report.sequence,
            },
        );
        if report.state == WorkerState::Drained {
            // It goes by itself and reports no more.
            self.told_to_stop.insert(report.worker.clone());
        }
        let answer = match self.record(&report, now).await {
            Ok(answer) => answer,
            Err(error) => {
                let _ = reply.send(Err(self.recover(&error).await));
                return;
            }
        };
        self.note_workers(now);
        let wait = report.max_wait.min(self.settings.report_interval).as_millis() as u64;
        let nothing_to_say = answer.grants.is_empty()
            && answer.revoked.is_empty()
            && answer.acknowledged.is_empty()
            && answer.order == Order::Work;
        if nothing_to_say && wait > 0 && report.state == WorkerState::Ready {
            let parked = Parked { free: slots(&report), until: now.plus(wait), answer, reply };
            self.parked.insert(report.worker, parked);
        } else {
            self.send(&report.worker, answer, reply);
        }
    }

    /// One step: the report's results and leases, then new jobs.
    async fn record(&mut self, report: &Report, now: Timestamp) -> Result<ReportReply, LedgerError> {
        let event = Event::Reported {
            worker: report.worker.clone(),
            host: host_of(&report.boot_id, &report.host),
            ready: report.state == WorkerState::Ready,
            held: report
                .held
                .iter()
                .map(|held| Held { job: held.job, attempt: held.attempt, started: held.started })
                .collect(),
            finished: report
                .finished
                .iter()
                .map(|finished| Finished {
                    job: finished.job,
                    attempt: finished.attempt,
                    ending: ending(&finished.outcome),
                })
                .collect(),
        };
        let outcomes = report.finished.iter().map(|f| ((f.job, f.attempt), &f.outcome)).collect();
        let payload = Payload { outcomes, ..Payload::default() };
        if self.seen.is_none() {
            self.catch_up().await?;
        }
        // A heartbeat with nothing in hand and nothing to be had costs the ledger nothing.
        let commands = decide(&self.snapshot, event.clone(), now);
        if commands.iter().all(|command| matches!(command, Command::Admit { .. })) {
            for command in &commands {
                self.snapshot.apply(command, now);
            }
            let mut answer = self.answer(report.offset_ms, &[]);
            let wants = self.wants_work(&report.worker, slots(report));
            if self.order == Order::Work {
                answer.grants = self.grant_alone(wants, now).await?;
            }
            return Ok(answer);
        }
        let mut step = self.begin(now).await?;
        let commands = decide(&self.snapshot, event, now);
        self.carry_out(&mut step, &commands, &payload, now).await?;
        let mut answer = self.answer(report.offset_ms, &commands);
        let wants = self.wants_work(&report.worker, slots(report));
        if self.order == Order::Work {
            answer.grants = self.grant(&mut step, wants, now).await?;
        }
        self.commit(step).await?;
        Ok(answer)
    }

    async fn grant(
        &mut self,
        step: &mut Step,
        wants: Event,
        now: Timestamp,
    ) -> Result<Vec<Grant>, LedgerError> {
        let commands = decide(&self.snapshot, wants, now);
        let mut grants = Vec::new();
        for command in self.carry_out(step, &commands, &Payload::default(), now).await? {
            let Command::Grant { job: id, attempt, .. } = command else { continue };
            let job = match step.job(&id).await {
                Ok(job) => job,
                Err(error @ LedgerError::Damaged { .. }) => {
                    self.give_up_unreadable(step, id, attempt, &error, now).await?;
                    continue;
                }
                Err(error) => return Err(error),
            };
            let input = |need| Input { job: need, produced: self.results.get(&need).cloned() };
            let inputs = job.needs.into_iter().map(input).collect();
            grants.push(Grant { job: id, attempt, spec: job.spec, inputs });
        }
        Ok(grants)
    }

    /// One row that does not decode must not roll back what else the step holds, for the same would
    /// happen at each repetition.
    async fn give_up_unreadable(
        &mut self,
        step: &mut Step,
        job: JobId,
        attempt: Attempt,
        error: &LedgerError,
        now: Timestamp,
    ) -> Result<(), LedgerError> {
        let failure = Outcome::Failure(Failure {
            code: "unreadable".to_owned(),
            message: with_causes(error),
            retryable: false,
            counts_against_job: true,
            lost_inputs: Vec::new(),
        });
        let commands = decide(&self.snapshot, Event::Unreadable { job, attempt }, now);
        let payload = Payload { outcomes: [((job, attempt), &failure)].into(), ..Payload::default() };
        self.carry_out(step, &commands, &payload, now).await?;
        Ok(())
    }

    /// Looks whether there is something to say now to those who wait.
    pub(super) async fn serve_parked(&mut self) {
        let now = self.now();
        let may_grant = self.order == Order::Work && self.snapshot.has_ready();
        let waiting: Vec<WorkerId> = self
            .parked
            .iter()
            .filter(|(_, parked)| {
                may_grant || self.order != Order::Work || parked.until <= now || parked.reply.is_closed()
            })
            .map(|(worker, _)| worker.clone())
            .collect();
        for worker in waiting {
            let Some(mut parked) = self.parked.remove(&worker) else { continue };
            if parked.reply.is_closed() {
                continue;
            }
            if may_grant {
                let wants = self.wants_work(&worker, parked.free);
                match self.grant_alone(wants, now).await {
                    Ok(grants) => parked.answer.grants = grants,
                    Err(error) => {
                        let _ = parked.reply.send(Err(self.recover(&error).await));
                        continue;
                    }
                }
            }
            if parked.answer.grants.is_empty() && self.order == Order::Work && parked.until > now {
                self.parked.insert(worker, parked);
            } else {
                self.send(&worker, parked.answer, parked.reply);
            }
        }
    }

    fn wants_work(&self, worker: &WorkerId, free: FreeSlots) -> Event {
        let waiting =
            self.parked.iter().filter(|(_, parked)| parked.free.fuse > 0 && !parked.reply.is_closed());
        let waiting = waiting.map(|(other, _)| other.clone()).collect();
        Event::WantsWork { worker: worker.clone(), free, waiting }
    }

    async fn grant_alone(&mut self, wants: Event, now: Timestamp) -> Result<Vec<Grant>, LedgerError> {
        if decide(&self.snapshot, wants.clone(), now).is_empty() {
            return Ok(Vec::new());
        }
        let mut step = self.begin(now).await?;
        let grants = self.grant(&mut step, wants, now).await?;
        self.commit(step).await?;
        Ok(grants)
    }

    fn send(
        &mut self,
        worker: &WorkerId,
        mut answer: ReportReply,
        reply: Reply<Result<ReportReply, ServiceError>>,
    ) {
        answer.order = self.order;
        answer.peers = self.peers_of(worker, &answer.grants);
        if self.order == Order::Stop {
            self.told_to_stop.insert(worker.clone());
        }
        // A caller that has gone meanwhile does not speak of these grants in its next report, so
        // they are taken back then.
        let _ = reply.send(Ok(answer));
    }

    /// Whom the worker may fetch the inputs of its grants from, and send its maps to.
    fn peers_of(&self, worker: &WorkerId, grants: &[Grant]) -> Vec<Peer> {
        let Some(WorkerInfo { place, .. }) = self.workers.get(worker) else { return Vec::new() };
        let inputs = grants.iter().flat_map(|grant| &grant.inputs);
        let producers = inputs.filter_map(|input| Some(input.produced.as_ref()?.worker.clone())).collect();
        let living = self.workers.iter().filter(|(other, _)| self.snapshot.is_alive(other));
        peers(living.map(|(other, info)| (other, &info.place)), worker, place, &producers)
    }

    /// What the worker is told of the commands that followed from its report.
    fn answer(&self, offset_ms: u64, commands: &[Command]) -> ReportReply {
        let revoked = |command: &Command| match *command {
            Command::Revoke { job, attempt } => Some(JobAttempt { job, attempt }),
            _ => None,
        };
        let acknowledged = |command: &Command| match *command {
            Command::Acknowledge { job, attempt } => Some(JobAttempt { job, attempt }),
            _ => None,
        };
        ReportReply {
            offset_ms,
            lease: self.settings.lease,
            report_interval: self.settings.report_interval,
            grants: Vec::new(),
            revoked: commands.iter().filter_map(revoked).collect(),
            acknowledged: commands.iter().filter_map(acknowledged).collect(),
            store: self.settings.store.clone(),
            order: self.order,
            peers: Vec::new(),
        }
    }
}

/// What workers have in common that can reach each other's memory. Containers have the boot id of their host.
fn host_of(boot_id: &str, name: &str) -> String {
    if boot_id.is_empty() { name.to_owned() } else { boot_id.to_owned() }
}

fn slots(report: &Report) -> FreeSlots {
    FreeSlots { infer: report.free.infer, fuse: report.free.fuse }
}

fn ending(outcome: &Outcome) -> Ending {
    match outcome {
        Outcome::Success(_) => Ending::Success,
        Outcome::Failure(failure) => Ending::Failure {
            retryable: failure.retryable,
            counts: failure.counts_against_job,
            lost: failure.lost_inputs.clone(),
        },
    }
}
