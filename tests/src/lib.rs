//! What crosses crates: pipeline, cluster and golden tests.
