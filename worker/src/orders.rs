//! What a worker makes of the orders of several coordinators: pure.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use planesweep_proto::Order;

/// How many leases long a worker that a coordinator sent away looks for another one that stays.
const PATIENCE_LEASES: u32 = 10;

/// What follows from an order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Do as it says.
    Obey,
    /// This coordinator goes, another may stay: go on with that one.
    Leave,
}

/// The coordinators of one ledger, by their places in the worker's list, and who of them goes.
#[derive(Debug)]
pub(crate) struct Orders {
    coordinators: usize,
    going: BTreeSet<usize>,
    /// Until when others are looked for: one said that it goes, and none was heard since that stays.
    looks_until: Option<Instant>,
}

impl Orders {
    /// None of these goes as far as is known.
    pub fn new(coordinators: usize) -> Self {
        Self { coordinators, going: BTreeSet::new(), looks_until: None }
    }

    /// Notes an order: workers go when every coordinator says so, or one does and no other is found.
    pub fn hear(&mut self, coordinator: usize, order: Order, lease: Duration, now: Instant) -> Verdict {
        if order == Order::Work {
            self.going.remove(&coordinator);
            self.looks_until = None;
            return Verdict::Obey;
        }
        self.going.insert(coordinator);
        self.looks_until.get_or_insert(now + PATIENCE_LEASES * lease);
        if self.going.len() < self.coordinators && !self.is_forsaken(now) {
            Verdict::Leave
        } else {
            Verdict::Obey
        }
    }

    /// Notes that a coordinator is there, although it has nothing to say.
    pub fn hear_of_one(&mut self) {
        self.looks_until = None;
    }

    /// Whether it was sent away and has looked for another coordinator long enough.
    pub fn is_forsaken(&self, now: Instant) -> bool {
        self.looks_until.is_some_and(|until| now > until)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEASE: Duration = Duration::from_secs(7);

    /// Orders, and what is made of them so many seconds after the start.
    struct Story(Orders, Instant);

    impl Story {
        fn of(coordinators: usize) -> Self {
            Self(Orders::new(coordinators), Instant::now())
        }

        fn at(&self, seconds: u64) -> Instant {
            self.1 + Duration::from_secs(seconds)
        }

        fn hear(&mut self, coordinator: usize, order: Order, seconds: u64) -> Verdict {
            let now = self.at(seconds);
            self.0.hear(coordinator, order, LEASE, now)
        }
    }

    #[test]
    fn the_only_coordinator_is_obeyed() {
        let mut story = Story::of(1);
        for order in [Order::Work, Order::Drain, Order::Stop] {
            assert_eq!(story.hear(0, order, 0), Verdict::Obey);
        }
    }

    #[test]
    fn a_worker_goes_when_all_coordinators_go() {
        let mut story = Story::of(2);
        assert_eq!(story.hear(0, Order::Drain, 0), Verdict::Leave);
        assert_eq!(story.hear(1, Order::Work, 1), Verdict::Obey);
        assert_eq!(story.hear(1, Order::Drain, 1000), Verdict::Obey);
        // The first was started again meanwhile.
        assert_eq!(story.hear(0, Order::Work, 1001), Verdict::Obey);
        assert_eq!(story.hear(1, Order::Stop, 1002), Verdict::Leave);
        assert_eq!(story.hear(0, Order::Stop, 1003), Verdict::Obey);
    }

    #[test]
    fn a_worker_that_is_sent_away_looks_for_others_for_ten_leases() {
        let mut story = Story::of(2);
        assert!(!story.0.is_forsaken(story.at(1000)), "nobody sent it away");
        assert_eq!(story.hear(1, Order::Drain, 0), Verdict::Leave);
        assert_eq!(story.hear(1, Order::Drain, 69), Verdict::Leave);
        assert!(!story.0.is_forsaken(story.at(70)) && story.0.is_forsaken(story.at(71)));
        assert_eq!(story.hear(1, Order::Drain, 71), Verdict::Obey);

        // One that stays, or answers that it is in trouble, is waited for as long as it takes.
        assert_eq!(story.hear(0, Order::Work, 72), Verdict::Obey);
        assert!(!story.0.is_forsaken(story.at(1000)));
        assert_eq!(story.hear(1, Order::Drain, 1000), Verdict::Leave);
        story.0.hear_of_one();
        assert!(!story.0.is_forsaken(story.at(2000)));
    }
}
