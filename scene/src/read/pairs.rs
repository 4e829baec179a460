//! pair.txt: the source views of each reference view, best first.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::SplitAsciiWhitespace;

use super::ReadError;
use crate::{SourceScore, ViewId, Warning};

/// What was repaired, counted over the file, for there may be a thousand of each.
#[derive(Default)]
struct Repairs {
    unknown: usize,
    own: usize,
    repeated: usize,
    unsorted: usize,
    miscounted: usize,
}

/// Parses a pair.txt. Entries that name an unknown view, their own reference view or a source for
/// the second time are left out, unsorted ones are sorted by falling score, and where fewer
/// views or sources are listed than announced those listed count, each with a warning;
/// what has no clear meaning (a reference view given twice, lines too many, no numbers) is refused.
pub(super) fn parse_pairs(
    path: &Path,
    text: &str,
    is_known: impl Fn(ViewId) -> bool,
    warnings: &mut Vec<Warning>,
) -> Result<BTreeMap<ViewId, Vec<SourceScore>>, ReadError> {
    let error = |line: usize, what: String| ReadError::Text { path: path.to_owned(), line, what };
    let lines = text.lines().enumerate().map(|(k, line)| (k + 1, line.split_ascii_whitespace()));
    let mut lines = lines.filter(|(_, words)| words.clone().next().is_some());
    let count: u32 = lines
        .next()
        .and_then(|(_, mut words)| single(&mut words))
        .ok_or_else(|| error(1, "no number of reference views".to_owned()))?;
    let mut pairs = BTreeMap::new();
    let mut repairs = Repairs::default();
    let mut given = 0;
    while let Some((number, mut words)) = lines.next() {
        if given == count {
            return Err(error(number, format!("more than the {count} reference views announced")));
        }
        let reference = single(&mut words)
            .map(ViewId)
            .ok_or_else(|| error(number, "no reference view's id".to_owned()))?;
        let Some((number, words)) = lines.next() else { break };
        given += 1;
        let (announced, listed) = parse_sources(words).map_err(|what| error(number, what))?;
        repairs.miscounted += usize::from(listed.len() != announced);
        let sources = repaired(reference, listed, &is_known, &mut repairs);
        if pairs.contains_key(&reference) {
            return Err(error(number, format!("reference view {reference} is given twice")));
        }
        if is_known(reference) {
            pairs.insert(reference, sources);
        } else {
            repairs.unknown += 1;
        }
    }
    if given < count {
        warnings.push(Warning::new(
            format!("{}: {count} reference views are announced, the file ends after {given}", path.display()),
            "look for a complete copy; views that are missing there get sources by overlap",
        ));
    }
    let harmless = "nothing: what is meant is clear";
    for (entries, what, advice) in [
        (
            repairs.unknown,
            "name a view that the scene does not have; they were left out",
            "see whether images or camera files were lost",
        ),
        (repairs.own, "name their own reference view; they were left out", harmless),
        (repairs.repeated, "name a source a second time; they were left out", harmless),
        (repairs.unsorted, "stand behind one of a lower score; they were sorted", harmless),
        (
            repairs.miscounted,
            "list another number of sources than they announce; those listed were taken",
            "see whether the file was cut or edited",
        ),
    ] {
        if entries > 0 {
            warnings.push(Warning::new(format!("{}: {entries} entries {what}", path.display()), advice));
        }
    }
    Ok(pairs)
}

fn single(words: &mut SplitAsciiWhitespace) -> Option<u32> {
    let value = words.next()?.parse().ok();
    value.filter(|_| words.next().is_none())
}

/// The number of sources announced, and those listed.
fn parse_sources(mut words: SplitAsciiWhitespace) -> Result<(usize, Vec<SourceScore>), String> {
    let announced: usize = words.next().and_then(|w| w.parse().ok()).ok_or("no number of sources")?;
    let mut sources = Vec::new();
    while let Some(word) = words.next() {
        let view = word.parse().map(ViewId).map_err(|_| format!("{word:?} is no view id"))?;
        let score = words.next().and_then(|w| w.parse::<f64>().ok()).filter(|score| score.is_finite());
        let score = score.ok_or_else(|| format!("source {view} has no score"))?;
        sources.push(SourceScore { view, score });
    }
    Ok((announced, sources))
}

fn repaired(
    reference: ViewId,
    listed: Vec<SourceScore>,
    is_known: impl Fn(ViewId) -> bool,
    repairs: &mut Repairs,
) -> Vec<SourceScore> {
    let mut sources: Vec<SourceScore> = Vec::with_capacity(listed.len());
    for source in listed {
        if source.view == reference {
            repairs.own += 1;
        } else if !is_known(source.view) {
            repairs.unknown += 1;
        } else if sources.iter().any(|earlier| earlier.view == source.view) {
            repairs.repeated += 1;
        } else {
            sources.push(source);
        }
    }
    repairs.unsorted += sources.windows(2).filter(|pair| pair[0].score < pair[1].score).count();
    sources.sort_by(|a, b| b.score.total_cmp(&a.score));
    sources
}

#[cfg(test)]
mod tests {
    use super::*;

    type Pairs = BTreeMap<ViewId, Vec<SourceScore>>;

    /// Views 0 to 4 exist.
    fn parsed(text: &str) -> (Result<Pairs, String>, Vec<Warning>) {
        let mut warnings = Vec::new();
        let pairs = parse_pairs(Path::new("pair.txt"), text, |id| id.0 < 5, &mut warnings);
        (pairs.map_err(|error| error.to_string()), warnings)
    }

    fn ids(pairs: &Pairs, reference: u32) -> Vec<u32> {
        pairs[&ViewId(reference)].iter().map(|s| s.view.0).collect()
    }

    #[test]
    fn references_in_any_order_with_any_number_of_sources() {
        let (pairs, warnings) = parsed("2\r\n4\r\n2 1 9.5 0 3 \r\n\r\n1\r\n0\r\n");
        let pairs = pairs.expect("a good file");
        assert_eq!(ids(&pairs, 4), [1, 0]);
        assert_eq!(pairs[&ViewId(4)][0].score, 9.5);
        assert!(ids(&pairs, 1).is_empty());
        assert!(warnings.is_empty());
    }

    #[test]
    fn pair_txt_with_unknown_repeated_own_or_unsorted_ids_is_repaired_with_a_warning() {
        let (pairs, warnings) = parsed("2\n0\n9 1 2 0 9 77 8 2 5 1 1 3 5\n9\n1 1 4\n");
        let pairs = pairs.expect("clear enough");
        assert_eq!(ids(&pairs, 0), [2, 3, 1]);
        assert!(!pairs.contains_key(&ViewId(9)));
        let expected = [
            "2 entries name a view that",
            "1 entries name their own",
            "1 entries name a source",
            "1 entries stand behind",
            "1 entries list another number",
        ];
        for (warning, part) in warnings.iter().zip(expected) {
            assert!(warning.what.contains(part), "{warning}");
        }
        assert_eq!(warnings.len(), 5);
    }

    #[test]
    fn a_pair_txt_that_ends_early_counts_as_far_as_it_goes() {
        for text in ["4294967295\n0\n1 1 5\n", "2\n0\n1 1 5\n3\n"] {
            let (pairs, warnings) = parsed(text);
            assert_eq!(ids(&pairs.expect("clear enough"), 0), [1]);
            assert!(
                warnings.len() == 1 && warnings[0].what.ends_with("the file ends after 1"),
                "{warnings:?}"
            );
        }
    }

    #[test]
    fn pair_txt_without_clear_meaning_is_refused() {
        for (text, what) in [
            ("", "at line 1: no number of reference views"),
            ("x\n", "at line 1: no number of reference views"),
            ("1\n0 2\n1 1 5\n", "at line 2: no reference view's id"),
            ("1\n0\n1 1 nan\n", "at line 3: source 1 has no score"),
            ("1\n0\n1 -1 4\n", "at line 3: \"-1\" is no view id"),
            ("2\n0\n1 1 5\n0\n1 2 5\n", "at line 5: reference view 0 is given twice"),
            ("1\n0\n1 1 5\n2\n0\n", "at line 4: more than the 1 reference views"),
        ] {
            let error = parsed(text).0.expect_err(text);
            assert!(error.contains(what), "{error}");
        }
    }
}
