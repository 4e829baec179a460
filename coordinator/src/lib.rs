//! Who does it: the ledger of jobs, scheduling decisions, and the gRPC service that workers report to.
