//! `report.json`: what was done, how long it took, and what became of every pixel.

use std::collections::BTreeMap;
use std::ops::Add;

use planesweep_scene::{Sampling, ViewId};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// All that is known of a run at its end. Numbers must be finite: JSON has no others.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunReport {
    /// The scene as the user named it.
    pub scene: String,
    /// Every parameter of the run by name.
    pub settings: BTreeMap<String, Value>,
    /// Versions and hashes by name: the program, its numerics, the weights, the device.
    pub versions: BTreeMap<String, String>,
    /// The stages in their order.
    pub stages: Vec<StageReport>,
    /// The views with a depth map, by id.
    pub views: Vec<ViewReport>,
    /// The views without one.
    pub skipped: Vec<SkippedView>,
    /// What was odd about the scene as a whole.
    pub warnings: Vec<String>,
    /// How many maps came to the jobs that needed them on each way, by the way's name.
    #[serde(default)]
    pub maps_by_way: BTreeMap<String, u64>,
    /// How many photographs and masks the store had to send to workers that did not have them.
    #[serde(default)]
    pub images_fetched: u64,
    /// Sums.
    pub totals: Totals,
}

/// One stage of the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageReport {
    /// Its name.
    pub name: String,
    /// Seconds from its start to its end.
    pub seconds: f64,
}

/// One view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewReport {
    /// Its id in the scene.
    pub id: ViewId,
    /// Its name in the scene.
    pub name: String,
    /// Columns of the working image.
    pub width: u32,
    /// Rows of the working image.
    pub height: u32,
    /// Nearest depth hypothesis, in scene units.
    pub depth_min: f64,
    /// Farthest depth hypothesis, in scene units.
    pub depth_max: f64,
    /// Number of depth hypotheses.
    pub depth_count: u32,
    /// Their spacing.
    pub sampling: Sampling,
    /// Names of the source views, best first.
    pub sources: Vec<String>,
    /// What became of its pixels.
    pub funnel: Funnel,
    /// Seconds of inference.
    pub seconds: f64,
    /// The preview, relative to the output folder.
    pub preview: Option<String>,
    /// What was odd about it.
    pub warnings: Vec<String>,
}

/// How many pixels of a depth map passed each filter in turn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Funnel {
    /// All pixels.
    pub pixels: u64,
    /// Those of enough confidence.
    pub photometric: u64,
    /// Those of them with a depth that no more views contradict than confirm; all where the method
    /// of fusion does not ask.
    pub visible: u64,
    /// Those of them on which enough views agree.
    pub geometric: u64,
    /// Those of them that became points: what another view emits is left out.
    pub emitted: u64,
}

impl Funnel {
    /// The steps in order, each with its name.
    pub fn steps(&self) -> [(&'static str, u64); 5] {
        [
            ("pixels", self.pixels),
            ("photometric", self.photometric),
            ("visible", self.visible),
            ("geometric", self.geometric),
            ("emitted", self.emitted),
        ]
    }
}

impl Add for Funnel {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            pixels: self.pixels + other.pixels,
            photometric: self.photometric + other.photometric,
            visible: self.visible + other.visible,
            geometric: self.geometric + other.geometric,
            emitted: self.emitted + other.emitted,
        }
    }
}

/// A view that has no depth map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SkippedView {
    /// Its name in the scene.
    pub name: String,
    /// Why.
    pub reason: String,
}

/// Sums over the run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Totals {
    /// Points of the cloud.
    pub points: u64,
    /// Seconds from start to end, of the command that ended the run.
    pub wall_seconds: f64,
    /// Jobs of the run.
    #[serde(default)]
    pub jobs: u64,
    /// Those of them that an earlier command had done; their seconds are in no [`Totals::wall_seconds`], but in the sums
    /// of the stages.
    #[serde(default)]
    pub jobs_done_before: u64,
}

impl Totals {
    /// What [`Totals::wall_seconds`] are the seconds of, in words.
    pub fn span(&self) -> String {
        match self.jobs_done_before {
            0 => "from start to end".to_owned(),
            before => format!("of this command; {before} of {} jobs were done before", self.jobs),
        }
    }
}

impl RunReport {
    /// The sum of the views' funnels.
    pub fn funnel(&self) -> Funnel {
        self.views.iter().fold(Funnel::default(), |sum, view| sum + view.funnel)
    }

    /// The report as JSON, indented, with a newline at its end.
    pub fn to_json(&self) -> serde_json::Result<String> {
        let mut json = serde_json::to_string_pretty(self)?;
        json.push('\n');
        Ok(json)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A made-up run.
    pub(crate) fn sample() -> RunReport {
        let view = |id: u32, photometric: u64| ViewReport {
            id: ViewId(id),
            name: format!("{id:08}.jpg"),
            width: 1152,
            height: 864,
            depth_min: 2.125,
            depth_max: 9.5,
            depth_count: 192,
            sampling: Sampling::Inverse,
            sources: vec!["00000001.jpg".into(), "00000003.jpg".into()],
            funnel: Funnel {
                pixels: 62_208,
                photometric,
                visible: photometric,
                geometric: photometric * 4 / 5,
                emitted: photometric * 3 / 5,
            },
            seconds: 14.25,
            preview: Some(format!("preview/{id:08}.png")),
            warnings: Vec::new(),
        };
        RunReport {
            scene: "scenes/castle".into(),
            settings: BTreeMap::from([
                ("max_size".into(), Value::from(1152)),
                ("sampling".into(), Value::from("auto")),
                ("min_confidence".into(), Value::from(0.8)),
            ]),
            versions: BTreeMap::from([("planesweep".into(), "0.1.0".into())]),
            stages: vec![
                StageReport { name: "read".into(), seconds: 0.5 },
                StageReport { name: "infer".into(), seconds: 132.0 },
                StageReport { name: "fuse".into(), seconds: 11.0 },
            ],
            views: vec![view(1, 50_000), view(2, 41_000)],
            skipped: vec![SkippedView {
                name: "lonely.jpg".into(),
                reason: "no other view sees its points".into(),
            }],
            warnings: vec!["3 points have no track".into()],
            maps_by_way: BTreeMap::from([("in process".into(), 11), ("by shared memory".into(), 3)]),
            images_fetched: 4,
            totals: Totals { points: 54_600, wall_seconds: 143.5, jobs: 9, jobs_done_before: 0 },
        }
    }

    #[test]
    fn json_survives_the_round_trip() {
        let report = sample();
        let json = report.to_json().expect("plain data");
        assert_eq!(serde_json::from_str::<RunReport>(&json).expect("valid"), report);
        let value: Value = serde_json::from_str(&json).expect("valid");
        assert_eq!(value["views"][0]["funnel"]["photometric"], 50_000);
        assert_eq!(value["views"][1]["sampling"], "inverse");
        assert_eq!(value["skipped"][0]["name"], "lonely.jpg");
    }

    #[test]
    fn funnels_add_up() {
        assert_eq!(sample().funnel().photometric, 91_000);
        assert_eq!(sample().funnel().steps()[4], ("emitted", 54_600));
    }
}
