//! The order of the views: along the view graph, so that neighbours in it share source images.

use std::collections::{BTreeMap, BTreeSet};

use planesweep_scene::ViewId;

use crate::views::SourceRanking;

/// All views that have an entry, each followed where possible by its best source that has not been
/// placed yet; a dead end goes back to the last view that still has one.
pub fn order_views(ranking: &SourceRanking) -> Vec<ViewId> {
    let mut order = Vec::with_capacity(ranking.len());
    let mut placed = BTreeSet::new();
    for &start in ranking.keys() {
        let mut path = vec![start];
        if placed.insert(start) {
            order.push(start);
        }
        while let Some(&last) = path.last() {
            let next = ranking[&last]
                .iter()
                .map(|source| source.view)
                .find(|view| ranking.contains_key(view) && !placed.contains(view));
            match next {
                Some(view) => {
                    placed.insert(view);
                    order.push(view);
                    path.push(view);
                }
                None => {
                    path.pop();
                }
            }
        }
    }
    order
}

/// Each view's `count` best sources, made symmetric: who is a neighbour of whom has that one as a
/// neighbour too. Best first by the better of the two scores, then by id.
pub fn symmetric_neighbours(ranking: &SourceRanking, count: usize) -> BTreeMap<ViewId, Vec<ViewId>> {
    let mut scores: BTreeMap<ViewId, BTreeMap<ViewId, f64>> =
        ranking.keys().map(|id| (*id, BTreeMap::new())).collect();
    for (&reference, sources) in ranking {
        for source in sources.iter().filter(|s| ranking.contains_key(&s.view)).take(count) {
            for (a, b) in [(reference, source.view), (source.view, reference)] {
                let score = scores.entry(a).or_default().entry(b).or_insert(source.score);
                *score = score.max(source.score);
            }
        }
    }
    let best_first = |neighbours: BTreeMap<ViewId, f64>| {
        let mut neighbours: Vec<_> = neighbours.into_iter().collect();
        neighbours.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        neighbours.into_iter().map(|(view, _)| view).collect()
    };
    scores.into_iter().map(|(view, neighbours)| (view, best_first(neighbours))).collect()
}

#[cfg(test)]
mod tests {
    use planesweep_scene::SourceScore;
    use proptest::prelude::*;

    use super::*;

    fn ranking(edges: &[(u32, &[u32])]) -> SourceRanking {
        let score = |(k, view): (usize, &u32)| SourceScore { view: ViewId(*view), score: 10.0 - k as f64 };
        edges.iter().map(|(v, s)| (ViewId(*v), s.iter().enumerate().map(score).collect())).collect()
    }

    #[test]
    fn the_order_follows_best_sources_and_comes_back_from_dead_ends() {
        let ranking = ranking(&[(1, &[5, 2]), (2, &[1]), (3, &[]), (5, &[1, 7]), (7, &[5])]);
        let order: Vec<u32> = order_views(&ranking).iter().map(|v| v.0).collect();
        assert_eq!(order, [1, 5, 7, 2, 3]);
    }

    #[test]
    fn neighbours_are_limited_before_they_are_made_symmetric() {
        let neighbours = symmetric_neighbours(&ranking(&[(1, &[2, 3]), (2, &[3]), (3, &[2])]), 1);
        assert_eq!(neighbours[&ViewId(1)], [ViewId(2)]);
        assert_eq!(neighbours[&ViewId(2)], [ViewId(1), ViewId(3)]);
        assert_eq!(neighbours[&ViewId(3)], [ViewId(2)]);
    }

    proptest! {
        #[test]
        fn every_view_stands_once_in_the_order_and_the_graph_is_symmetric(
            edges in proptest::collection::btree_map(
                0_u32..20, proptest::collection::vec(0_u32..25, 0..8), 0..20)
        ) {
            let ranking: SourceRanking = edges.iter().map(|(v, s)| {
                let sources = s.iter().filter(|x| *x != v).map(|x| SourceScore { view: ViewId(*x), score: *x as f64 });
                (ViewId(*v), sources.collect())
            }).collect();
            let order = order_views(&ranking);
            let mut sorted = order.clone();
            sorted.sort();
            prop_assert_eq!(sorted, ranking.keys().copied().collect::<Vec<_>>());
            let neighbours = symmetric_neighbours(&ranking, 3);
            for (a, list) in &neighbours {
                prop_assert!(!list.contains(a));
                for b in list {
                    prop_assert!(neighbours[b].contains(a));
                }
            }
        }
    }
}
