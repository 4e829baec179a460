//! What a worker makes of the orders of several coordinators: pure.

use std::collections::BTreeSet;

use planesweep_proto::Order;

/// What follows from an order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Do as it says.
    Obey,
    /// This coordinator goes, another stays: go on with that one.
    Leave,
}

/// The coordinators of one ledger, by their places in the worker's list, and who of them goes.
#[derive(Debug)]
pub(crate) struct Orders {
    coordinators: usize,
    going: BTreeSet<usize>,
}

impl Orders {
    /// None of these goes as far as is known.
    pub fn new(coordinators: usize) -> Self {
        Self { coordinators, going: BTreeSet::new() }
    }

    /// Notes an order: workers go when every coordinator says so.
    pub fn hear(&mut self, coordinator: usize, order: Order) -> Verdict {
        if order == Order::Work {
            self.going.remove(&coordinator);
            return Verdict::Obey;
        }
        self.going.insert(coordinator);
        if self.going.len() < self.coordinators { Verdict::Leave } else { Verdict::Obey }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_only_coordinator_is_obeyed() {
        let mut orders = Orders::new(1);
        for order in [Order::Work, Order::Drain, Order::Stop] {
            assert_eq!(orders.hear(0, order), Verdict::Obey);
        }
    }

    #[test]
    fn a_worker_goes_when_all_coordinators_go() {
        let mut orders = Orders::new(2);
        assert_eq!(orders.hear(0, Order::Drain), Verdict::Leave);
        assert_eq!(orders.hear(1, Order::Work), Verdict::Obey);
        assert_eq!(orders.hear(1, Order::Drain), Verdict::Obey);
        // The first was started again meanwhile.
        assert_eq!(orders.hear(0, Order::Work), Verdict::Obey);
        assert_eq!(orders.hear(1, Order::Stop), Verdict::Leave);
        assert_eq!(orders.hear(0, Order::Stop), Verdict::Obey);
    }
}
