//! The 3D network as a pipeline of stages (paper section 3.2, four scales with additive skips).

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::layers::RegularizationLayers;
use super::stages::{CostRows, DownStage, PlainStage, RegressionStage, UpStage};
use crate::kernels::cost::{CHANNELS, CostInput};
use crate::kernels::regress::Regressed;
use crate::kernels::simd::Level;
use crate::kernels::slab::{Pool, Shape};

/// Where the time went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct VolumeTimes {
    /// Warp, variance and the first layer.
    pub(crate) cost: Duration,
    /// The layers between.
    pub(crate) regularization: Duration,
    /// The last layer and the regression.
    pub(crate) regression: Duration,
}

/// The state between two rows.
#[derive(Debug)]
pub(crate) struct Regularization<'a> {
    layers: &'a RegularizationLayers,
    level: Level,
    taken: usize,
    plain: [PlainStage; 4],
    down: [DownStage; 3],
    up: [UpStage; 3],
    pub(crate) regression: RegressionStage,
    pub(crate) times: VolumeTimes,
}

impl<'a> Regularization<'a> {
    /// For a volume of `height` rows of this width and number of depths; both sizes are multiples of 8.
    /// `window` probabilities make the confidence.
    pub(crate) fn new(
        pool: &Arc<Pool>,
        layers: &'a RegularizationLayers,
        level: Level,
        (width, height, depths): (usize, usize, usize),
        window: u32,
    ) -> Self {
        let cost = Shape { columns: width, channels: CHANNELS, length: depths };
        let plain0 = PlainStage::new(pool, &layers.plain[0], cost, height);
        let down0 = DownStage::new(pool, &layers.down[0], plain0.output());
        let plain1 = PlainStage::new(pool, &layers.plain[1], down0.output(), height / 2);
        let down1 = DownStage::new(pool, &layers.down[1], plain1.output());
        let plain2 = PlainStage::new(pool, &layers.plain[2], down1.output(), height / 4);
        let down2 = DownStage::new(pool, &layers.down[2], plain2.output());
        let plain3 = PlainStage::new(pool, &layers.plain[3], down2.output(), height / 8);
        let up = [
            UpStage::new(pool, plain2.output(), height / 8),
            UpStage::new(pool, plain1.output(), height / 4),
            UpStage::new(pool, plain0.output(), height / 2),
        ];
        let regression = RegressionStage::new(plain0.output(), height, window);
        Self {
            layers,
            level,
            taken: 0,
            plain: [plain0, plain1, plain2, plain3],
            down: [down0, down1, down2],
            up,
            regression,
            times: VolumeTimes::default(),
        }
    }

    /// Takes the next `count` rows of the cost volume, whose first row is row `first` of the reference. Gives the
    /// pixels of the depth map's next rows, none or more.
    pub(crate) fn push(&mut self, cost: &CostInput<'_>, first: usize, count: usize) -> Vec<Regressed> {
        let begin = Instant::now();
        let row = first + self.taken;
        self.taken += count;
        let RegularizationLayers { plain, down, up, prob } = self.layers;
        let mut rows = self.plain[0].push_from(&plain[0], count, || CostRows::new(cost, self.level, row));
        self.times.cost += begin.elapsed();

        let begin = Instant::now();
        for i in 0..3 {
            self.up[2 - i].push_skip(&rows);
            let smaller = self.down[i].push(&down[i], &rows);
            rows = self.plain[i + 1].push(&plain[i + 1], &smaller);
        }
        for (stage, layer) in self.up.iter_mut().zip(up) {
            rows = stage.push(layer, &rows);
        }
        self.times.regularization += begin.elapsed();

        let begin = Instant::now();
        let pixels = self.regression.push(prob, &rows);
        self.times.regression += begin.elapsed();
        pixels
    }
}
