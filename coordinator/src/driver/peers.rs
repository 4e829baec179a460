//! Which workers one is told of: pure.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use planesweep_plan::WorkerId;
use planesweep_proto::{Endpoint, Peer};

/// Where a worker is.
#[derive(Clone, Debug, Default)]
pub(super) struct Place {
    pub host: String,
    pub boot_id: String,
    pub endpoint: Endpoint,
}

/// Of the workers that live, those that a worker may fetch from, because they are among `producers`,
/// and those that it may send to, because they have an inbox on its host; the nearest first.
///
/// Containers have names of their own but the boot id of their host. Whether they share its memory, they
/// find out by themselves; that they do not share its loopback is certain.
pub(super) fn peers<'a>(
    living: impl Iterator<Item = (&'a WorkerId, &'a Place)>,
    worker: &WorkerId,
    place: &Place,
    producers: &BTreeSet<WorkerId>,
) -> Vec<Peer> {
    let mut peers: Vec<(bool, Peer)> = living
        .filter(|(other, _)| *other != worker)
        .filter_map(|(other, at)| {
            let shares_kernel = !place.boot_id.is_empty() && at.boot_id == place.boot_id;
            let shares_host = shares_kernel && at.host == place.host;
            let address = at.endpoint.address.clone().filter(|url| shares_host || !is_loopback(url))?;
            let inbox = at.endpoint.inbox.clone().filter(|_| shares_kernel);
            let endpoint = Endpoint { address: Some(address), inbox };
            (endpoint.inbox.is_some() || producers.contains(other))
                .then(|| (!shares_host, Peer { worker: other.clone(), endpoint }))
        })
        .collect();
    peers.sort_by(|(far, peer), (other_far, other)| (far, &peer.worker).cmp(&(other_far, &other.worker)));
    peers.into_iter().map(|(_, peer)| peer).collect()
}

fn is_loopback(url: &str) -> bool {
    let address = url.split_once("://").map_or(url, |(_, rest)| rest);
    address.parse::<SocketAddr>().is_ok_and(|address| address.ip().is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(host: &str, boot_id: &str, address: &str, inbox: Option<&str>) -> Place {
        let endpoint = Endpoint { address: Some(address.into()), inbox: inbox.map(Into::into) };
        Place { host: host.into(), boot_id: boot_id.into(), endpoint }
    }

    fn told(of: &Place, others: &[(&str, Place)], producers: &[&str]) -> Vec<(String, Option<String>)> {
        let ids: Vec<(WorkerId, &Place)> =
            others.iter().map(|(id, at)| (WorkerId((*id).to_owned()), at)).collect();
        let producers = producers.iter().map(|id| WorkerId((*id).to_owned())).collect();
        let living = ids.iter().map(|(id, at)| (id, *at));
        let peers = peers(living, &WorkerId("me".into()), of, &producers);
        peers.into_iter().map(|peer| (peer.worker.0, peer.endpoint.inbox)).collect()
    }

    #[test]
    fn inboxes_are_named_on_the_own_host_and_producers_wherever_they_can_be_reached() {
        let me = place("a", "k1", "http://127.0.0.1:1", None);
        let others = [
            ("me", me.clone()),
            ("fuses", place("a", "k1", "http://127.0.0.1:2", Some("in"))),
            ("infers", place("a", "k1", "http://127.0.0.1:3", None)),
            ("container", place("c", "k1", "http://10.0.0.3:1", Some("inc"))),
            ("alone", place("d", "k1", "http://127.0.0.1:2", Some("ind"))),
            ("far", place("b", "k2", "http://b:1", Some("inb"))),
            ("namesake", place("a", "k3", "http://[::1]:1", Some("ina"))),
        ];
        let inbox = |name: &str| Some(name.to_owned());
        let near = [("fuses".to_owned(), inbox("in")), ("container".to_owned(), inbox("inc"))];
        assert_eq!(told(&me, &others, &[]), near);
        let all = told(&me, &others, &["me", "infers", "far", "namesake", "unknown"]);
        let [fuses, container] = near;
        assert_eq!(all, [fuses, ("infers".into(), None), container, ("far".into(), None)]);
    }

    #[test]
    fn without_a_boot_id_no_two_workers_are_on_one_host() {
        let me = place("a", "", "http://127.0.0.1:1", None);
        let other = place("a", "", "http://127.0.0.1:2", Some("in"));
        assert!(told(&me, &[("other", other)], &["other"]).is_empty());
    }
}
