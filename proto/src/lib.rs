//! The wire: the gRPC contract and its checked conversion to and from domain types.
