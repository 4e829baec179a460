//! Doing it: leases jobs, infers or fuses, stores the result and reports it.
