//! Sparse points on their way into a scene.

use crate::{Scene, ViewId, Warning};

/// Takes points in: those that are not finite are counted and left out, views that the scene does
/// not have vanish from tracks.
pub(super) struct PointsInto<'a> {
    scene: &'a mut Scene,
    not_finite: usize,
}

impl<'a> PointsInto<'a> {
    pub fn new(scene: &'a mut Scene) -> Self {
        Self { scene, not_finite: 0 }
    }

    pub fn push(&mut self, position: [f64; 3], track: impl IntoIterator<Item = u32>) {
        if position.iter().all(|v| v.is_finite()) {
            let Scene { views, points, .. } = &mut *self.scene;
            let track = track.into_iter().map(ViewId);
            points.push(position.into(), track.filter(|id| views.contains_key(id)));
        } else {
            self.not_finite += 1;
        }
    }

    /// Ends with the warning that is due.
    pub fn finish(self) {
        if self.not_finite > 0 {
            let what = "sparse points are not finite and were left out";
            let advice = "solve the scene again if they are many: it did not converge there";
            self.scene.warnings.push(Warning::new(format!("{} {what}", self.not_finite), advice));
        }
    }
}
