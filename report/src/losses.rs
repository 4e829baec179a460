//! What each step of fusion dropped, and what to do when it drops most.

use crate::Funnel;

/// What one step dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loss {
    /// The step.
    pub step: &'static str,
    /// Pixels that it dropped.
    pub pixels: u64,
    /// Whether no other step dropped more; leaving out what another view emits is no loss.
    pub is_largest: bool,
    /// Why it drops pixels.
    pub reason: &'static str,
    /// What to do when these are too many.
    pub advice: &'static str,
}

impl Funnel {
    /// The losses of all steps, in order.
    pub fn losses(&self) -> [Loss; 4] {
        let loss = |step, before: u64, after: u64, reason, advice| Loss {
            step,
            pixels: before.saturating_sub(after),
            is_largest: false,
            reason,
            advice,
        };
        let mut losses = [
            loss(
                "photometric",
                self.pixels,
                self.photometric,
                "the network was not sure: sky, walls without texture, reflections, what no source view sees, and \
                 what a mask leaves out",
                "see the confidence in the previews. If it is low where the surface has texture, the depth range or \
                 the source views are wrong (planesweep inspect says), or the weights were trained on other scenes; \
                 else try --min-confidence 0.5",
            ),
            loss(
                "visible",
                self.photometric,
                self.visible,
                "other views see through the depth, or something before it",
                "expected at the edges of objects; elsewhere check the cameras (planesweep inspect)",
            ),
            loss(
                "geometric",
                self.visible,
                self.geometric,
                "fewer other views than asked for have the same depth there",
                "more photographs with overlap help most. With few views --min-views 2; with wide baselines a finer \
                 depth map (--max-size); if nearly all is dropped, the cameras do not belong to the photographs",
            ),
            loss(
                "emitted",
                self.geometric,
                self.emitted,
                "a closer view emits the same surface: nothing is missing",
                "--every-view emits all of them",
            ),
        ];
        let most = losses[..3].iter().map(|loss| loss.pixels).max().unwrap_or(0);
        if let Some(largest) = losses[..3].iter_mut().find(|loss| loss.pixels == most && most > 0) {
            largest.is_largest = true;
        }
        losses
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_step_that_drops_most_is_named_but_for_the_last() {
        let funnel = Funnel { pixels: 100, photometric: 80, visible: 80, geometric: 50, emitted: 5 };
        let losses = funnel.losses();
        assert_eq!(losses.map(|loss| loss.pixels), [20, 0, 30, 45]);
        assert_eq!(losses.map(|loss| loss.is_largest), [false, false, true, false]);
        assert!(Funnel::default().losses().iter().all(|loss| !loss.is_largest && loss.pixels == 0));
    }
}
