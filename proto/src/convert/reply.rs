//! Replies to reports, and the store's place.

use std::time::Duration;

use planesweep_plan::WorkerId;

use super::check::{at_most, attempt, each, in_range, job_id, name, optional_name, required, short};
use super::report::{endpoint, millis};
use crate::limits::{MAX_MESSAGE_TEXT_BYTES, MAX_PEERS, MAX_REPORTED, MAX_VIEWS};
use crate::{Grant, Input, JobAttempt, Order, Peer, Produced, ReportReply, StorePlace, WireError, wire};

impl From<&ReportReply> for wire::ReportReply {
    fn from(reply: &ReportReply) -> Self {
        let order = match reply.order {
            Order::Work => wire::Order::Work,
            Order::Drain => wire::Order::Drain,
            Order::Stop => wire::Order::Stop,
        };
        Self {
            offset_ms: reply.offset_ms,
            lease_ms: millis(reply.lease),
            report_interval_ms: millis(reply.report_interval),
            grants: reply.grants.iter().map(Into::into).collect(),
            revoked: reply.revoked.iter().map(|job| (*job).into()).collect(),
            acknowledged: reply.acknowledged.iter().map(|job| (*job).into()).collect(),
            store_url: reply.store.url.clone(),
            order: order.into(),
            peers: reply.peers.iter().map(Into::into).collect(),
            store_identity: reply.store.identity.clone().unwrap_or_default(),
        }
    }
}

impl TryFrom<wire::ReportReply> for ReportReply {
    type Error = WireError;

    fn try_from(reply: wire::ReportReply) -> Result<Self, WireError> {
        let positive =
            |field, ms| in_range(field, ms, 1, u32::MAX).map(|ms| Duration::from_millis(ms.into()));
        at_most("grants", reply.grants.len(), MAX_REPORTED)?;
        at_most("revoked", reply.revoked.len(), MAX_REPORTED)?;
        at_most("acknowledged", reply.acknowledged.len(), MAX_REPORTED)?;
        at_most("peers", reply.peers.len(), MAX_PEERS)?;
        Ok(Self {
            offset_ms: reply.offset_ms,
            lease: positive("lease", reply.lease_ms)?,
            report_interval: positive("report interval", reply.report_interval_ms)?,
            grants: each(reply.grants, TryInto::try_into)?,
            revoked: each(reply.revoked, TryInto::try_into)?,
            acknowledged: each(reply.acknowledged, TryInto::try_into)?,
            store: store_place(reply.store_url, reply.store_identity)?,
            order: match wire::Order::try_from(reply.order) {
                Ok(wire::Order::Work) => Order::Work,
                Ok(wire::Order::Drain) => Order::Drain,
                Ok(wire::Order::Stop) => Order::Stop,
                _ => return Err(WireError::UnknownValue { field: "order", value: reply.order }),
            },
            peers: each(reply.peers, TryInto::try_into)?,
        })
    }
}

fn store_place(url: String, identity: String) -> Result<StorePlace, WireError> {
    let url = short("store url", url, MAX_MESSAGE_TEXT_BYTES)?;
    let identity = optional_name("store identity", identity)?;
    Ok(StorePlace { url, identity: Some(identity).filter(|identity| !identity.is_empty()) })
}

impl From<&StorePlace> for wire::DescribeReply {
    fn from(store: &StorePlace) -> Self {
        let store_identity = store.identity.clone().unwrap_or_default();
        Self { store_url: store.url.clone(), store_identity }
    }
}

impl TryFrom<wire::DescribeReply> for StorePlace {
    type Error = WireError;

    fn try_from(reply: wire::DescribeReply) -> Result<Self, WireError> {
        store_place(reply.store_url, reply.store_identity)
    }
}

impl From<JobAttempt> for wire::JobAttempt {
    fn from(of: JobAttempt) -> Self {
        Self { job: of.job.0.to_vec(), attempt: of.attempt.0 }
    }
}

impl TryFrom<wire::JobAttempt> for JobAttempt {
    type Error = WireError;

    fn try_from(of: wire::JobAttempt) -> Result<Self, WireError> {
        Ok(Self { job: job_id("job", &of.job)?, attempt: attempt(of.attempt)? })
    }
}

impl From<&Grant> for wire::Grant {
    fn from(grant: &Grant) -> Self {
        Self {
            job: grant.job.0.to_vec(),
            attempt: grant.attempt.0,
            spec: Some((&grant.spec).into()),
            inputs: grant.inputs.iter().map(Into::into).collect(),
        }
    }
}

impl TryFrom<wire::Grant> for Grant {
    type Error = WireError;

    fn try_from(grant: wire::Grant) -> Result<Self, WireError> {
        at_most("inputs", grant.inputs.len(), MAX_VIEWS)?;
        Ok(Self {
            job: job_id("granted job", &grant.job)?,
            attempt: attempt(grant.attempt)?,
            spec: required("spec", grant.spec)?.try_into()?,
            inputs: each(grant.inputs, TryInto::try_into)?,
        })
    }
}

impl From<&Input> for wire::Input {
    fn from(input: &Input) -> Self {
        let produced = input.produced.as_ref();
        Self {
            job: input.job.0.to_vec(),
            blob: produced.map(|p| (p.blob, p.length).into()),
            producer: produced.map(|p| p.worker.0.clone()).unwrap_or_default(),
        }
    }
}

impl TryFrom<wire::Input> for Input {
    type Error = WireError;

    fn try_from(input: wire::Input) -> Result<Self, WireError> {
        let produced = match input.blob {
            None => None,
            Some(blob) => {
                let (blob, length) = blob.try_into()?;
                Some(Produced { blob, length, worker: WorkerId(name("producer", input.producer)?) })
            }
        };
        Ok(Self { job: job_id("input", &input.job)?, produced })
    }
}

impl From<&Peer> for wire::Peer {
    fn from(peer: &Peer) -> Self {
        Self {
            worker: peer.worker.0.clone(),
            address: peer.endpoint.address.clone().unwrap_or_default(),
            inbox: peer.endpoint.inbox.clone().unwrap_or_default(),
        }
    }
}

impl TryFrom<wire::Peer> for Peer {
    type Error = WireError;

    fn try_from(peer: wire::Peer) -> Result<Self, WireError> {
        Ok(Self {
            worker: WorkerId(name("peer", peer.worker)?),
            endpoint: endpoint(peer.address, peer.inbox)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use planesweep_plan::{BlobKey, EmitSpec, JobSpec};
    use planesweep_scene::ViewId;
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::super::report::tests::job;
    use super::*;
    use crate::Endpoint;

    fn input() -> impl Strategy<Value = Input> {
        let produced = ("[a-z]{1,9}", any::<[u8; 32]>(), any::<u64>()).prop_map(|(worker, blob, length)| {
            Produced { blob: BlobKey(blob), length, worker: WorkerId(worker) }
        });
        (job(), proptest::option::of(produced)).prop_map(|((job, _), produced)| Input { job, produced })
    }

    fn reply() -> impl Strategy<Value = ReportReply> {
        let grants = vec((job(), any::<u32>(), vec(input(), 0..4)), 0..3).prop_map(|grants| {
            let grant = |((job, attempt), view, inputs)| {
                let spec = JobSpec::Emit(EmitSpec {
                    view: ViewId(view),
                    neighbours: vec![ViewId(2)],
                    max_relative_depth: 0.01,
                    double: false,
                });
                Grant { job, attempt, spec, inputs }
            };
            grants.into_iter().map(grant).collect()
        });
        let attempts = || {
            vec(job(), 0..4)
                .prop_map(|jobs| jobs.into_iter().map(|(job, attempt)| JobAttempt { job, attempt }).collect())
        };
        let order = prop_oneof![Just(Order::Work), Just(Order::Drain), Just(Order::Stop)];
        let text = || proptest::option::of("[a-z:/0-9]{1,9}");
        let peers = vec(("[a-z]{1,9}", text(), text()), 0..3).prop_map(|peers| {
            let peer = |(worker, address, inbox)| Peer {
                worker: WorkerId(worker),
                endpoint: Endpoint { address, inbox },
            };
            peers.into_iter().map(peer).collect()
        });
        let store = ("[a-z:/0-9]{1,9}", text()).prop_map(|(url, identity)| StorePlace { url, identity });
        (any::<u64>(), 1..u32::MAX, grants, attempts(), attempts(), store, order, peers).prop_map(
            |(offset_ms, ms, grants, revoked, acknowledged, store, order, peers)| ReportReply {
                offset_ms,
                lease: Duration::from_millis(ms.into()),
                report_interval: Duration::from_millis(ms.into()),
                grants,
                revoked,
                acknowledged,
                store,
                order,
                peers,
            },
        )
    }

    proptest! {
        #[test]
        fn replies_survive_the_wire(reply in reply()) {
            prop_assert_eq!(ReportReply::try_from(wire::ReportReply::from(&reply)), Ok(reply));
        }
    }
}
