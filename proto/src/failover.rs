//! Equal servers, of which one is called until it cannot be reached.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use tonic::Status;

use crate::{Code, ServiceError};

/// The clients of equal servers. Clones share them and the choice.
#[derive(Clone, Debug)]
pub(crate) struct Failover<S> {
    stubs: Arc<[S]>,
    current: Arc<AtomicUsize>,
}

impl<S: Clone> Failover<S> {
    /// The first is called first; there must be one.
    pub fn new(stubs: Vec<S>) -> Self {
        assert!(!stubs.is_empty(), "a client of nobody");
        Self { stubs: stubs.into(), current: Arc::default() }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.stubs.len()
    }

    /// Which one is called now.
    pub fn current(&self) -> usize {
        self.current.load(Ordering::Relaxed)
    }

    /// Goes on to the next, unless somebody else has done so.
    pub fn leave(&self, member: usize) {
        let next = (member + 1) % self.len();
        let _ = self.current.compare_exchange(member, next, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// Calls the current one; when it cannot be reached, the next call goes to another.
    pub async fn call<T, F>(&self, call: impl FnOnce(S) -> F) -> Result<T, ServiceError>
    where
        F: Future<Output = Result<T, Status>>,
    {
        let member = self.current();
        let answer = call(self.stubs[member].clone()).await.map_err(ServiceError::from);
        if answer.as_ref().is_err_and(|error| error.code == Code::Unavailable) {
            self.leave(member);
        }
        answer
    }

    /// Calls one after the other until one answers.
    pub async fn call_any<T, F>(&self, call: impl Fn(S) -> F) -> Result<T, ServiceError>
    where
        F: Future<Output = Result<T, Status>>,
    {
        for _ in 1..self.len() {
            match self.call(&call).await {
                Err(error) if error.code == Code::Unavailable => {}
                answer => return answer,
            }
        }
        self.call(&call).await
    }
}

#[cfg(test)]
mod tests {
    use std::future::{Ready, ready};

    use super::*;

    fn answer(member: usize, alive: &[usize]) -> Ready<Result<usize, Status>> {
        ready(if alive.contains(&member) { Ok(member) } else { Err(Status::unavailable("gone")) })
    }

    #[tokio::test]
    async fn who_cannot_be_reached_is_left_for_the_next() {
        let members = Failover::new(vec![0, 1, 2]);
        let clone = members.clone();
        assert_eq!(members.call(|member| answer(member, &[0, 2])).await, Ok(0));
        assert!(members.call(|member| answer(member, &[2])).await.is_err());
        assert_eq!(clone.current(), 1);
        assert_eq!(clone.call_any(|member| answer(member, &[2])).await, Ok(2));
        assert_eq!(members.call_any(|member| answer(member, &[1])).await, Ok(1));
        assert!(members.call_any(|member| answer(member, &[])).await.is_err());
        members.leave(members.current() + 1);
        assert_eq!(members.current(), 1, "only the current one is left");
    }

    #[tokio::test]
    async fn a_refusal_is_an_answer() {
        let members = Failover::new(vec![0, 1]);
        let refused = members.call_any(|_| ready(Err::<(), _>(Status::unauthenticated("who?")))).await;
        assert_eq!(refused.map_err(|error| error.code), Err(Code::Unauthenticated));
        assert_eq!(members.current(), 0);
    }
}
