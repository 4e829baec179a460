//! Why views are missing, in few words.

/// How many are told of; the others are counted.
const TOLD: usize = 3;

/// The first of the reasons, each behind the name of its view, and how many more there are; starts with ": ",
/// and is empty without any.
pub fn first_reasons<N: ToString, R: ToString>(reasons: impl IntoIterator<Item = (N, R)>) -> String {
    let mut reasons = reasons.into_iter();
    let mut told: Vec<String> = reasons
        .by_ref()
        .take(TOLD)
        .map(|(view, reason)| format!("{}: {}", view.to_string(), reason.to_string()))
        .collect();
    let more = reasons.count();
    if more > 0 {
        told.push(format!("and {more} more"));
    }
    if told.is_empty() { String::new() } else { format!(": {}", told.join("; ")) }
}

#[cfg(test)]
mod tests {
    use super::first_reasons;

    #[test]
    fn the_first_are_told_and_the_others_counted() {
        let of = |count: usize| first_reasons((0..count).map(|view| (view, "gone")));
        assert_eq!(of(0), "");
        assert_eq!(of(1), ": 0: gone");
        assert_eq!(of(5), ": 0: gone; 1: gone; 2: gone; and 2 more");
    }
}
