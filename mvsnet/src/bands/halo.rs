//! Which rows of the volume a band of the depth map is made of.

use std::ops::Range;

/// Halvings of the volume.
const SCALES: u32 = 3;

/// Rows of a layer that the given rows of its output are made of.
#[derive(Clone, Copy)]
enum Layer {
    /// Size 3, stride 1.
    Plain,
    /// Size 3, stride 2.
    Down,
    /// Size 3, stride 2, transposed.
    Up,
}

impl Layer {
    fn input(self, rows: &Range<isize>) -> Range<isize> {
        match self {
            Self::Plain => rows.start - 1..rows.end + 1,
            Self::Down => 2 * rows.start - 1..2 * rows.end,
            Self::Up => rows.start.div_euclid(2)..rows.end.div_euclid(2) + 1,
        }
    }
}

/// The rows of the cost volume that these rows of the (unrefined) depth map depend on, within `height`, from a
/// multiple of 8 to a multiple of 8, so that every scale begins with a whole row.
pub(crate) fn rows_for_depth(rows: &Range<usize>, height: usize) -> Range<usize> {
    let rows = Layer::Plain.input(&(rows.start as isize..rows.end as isize));
    let needed = volume_input(&rows, SCALES);
    let phase = 1 << SCALES;
    let start = needed.start.max(0) as usize / phase * phase;
    start..(needed.end.max(0) as usize).next_multiple_of(phase).min(height)
}

/// Rows of the first of `scales + 1` scales' input that rows of its output need, by way of the skip or of the
/// scales below.
fn volume_input(rows: &Range<isize>, scales: u32) -> Range<isize> {
    if scales == 0 {
        return Layer::Plain.input(rows);
    }
    let below = volume_input(&Layer::Up.input(rows), scales - 1);
    let strided = Layer::Down.input(&below);
    let both = strided.start.min(rows.start)..strided.end.max(rows.end);
    Layer::Plain.input(&both)
}

/// The rows of the unrefined depth map that these rows of the refined one depend on, within `height` (which is even),
/// from an even row to an even row, since the kernels compute pairs.
pub(crate) fn rows_for_refinement(rows: &Range<usize>, height: usize) -> Range<usize> {
    let needed = (0..4).fold(rows.start as isize..rows.end as isize, |rows, _| Layer::Plain.input(&rows));
    let start = needed.start.max(0) as usize / 2 * 2;
    start..(needed.end as usize).next_multiple_of(2).min(height)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halo_is_at_most_what_the_design_says() {
        for row in 0..400 {
            let needed = rows_for_depth(&(row + 100..row + 101), 1000);
            assert!(needed.start.is_multiple_of(8) && needed.end.is_multiple_of(8));
            let (ahead, behind) = (needed.end - (row + 101), row + 100 - needed.start);
            assert!((23..=38).contains(&ahead) && (23..=38).contains(&behind), "{ahead} {behind}");
        }
    }

    #[test]
    fn borders_of_the_image_end_the_halo() {
        assert_eq!(rows_for_depth(&(0..10), 64), 0..40);
        assert_eq!(rows_for_depth(&(40..64), 64), 8..64);
        assert_eq!(rows_for_refinement(&(0..64), 64), 0..64);
        assert_eq!(rows_for_refinement(&(9..12), 64), 4..16);
    }
}
