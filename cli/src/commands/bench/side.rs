//! One side of a bench: a process that loads a view, then infers it whenever a line asks for that.

use std::fmt;
use std::fs;
use std::io::{Write, stdin, stdout};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use planesweep_mvsnet::{
    CpuBackend, DepthBackend, InferInput, InferSize, InferTimes, PlainTimes, Refinement, TorchBackend,
    Weights, WeightsMetadata,
};
use planesweep_plan::{PlanOptions, SamplingChoice, ViewPlan, plan};
use planesweep_scene::{DepthMap, ReadOptions, WorkingImage, read_image, write_pfm};
use safetensors::tensor::{Dtype, TensorView};
use serde::{Deserialize, Serialize};

use crate::commands::depth::find;
use crate::console::Outcome;
use crate::input;
use crate::network::read_weights;

/// Arguments of the hidden command `bench-side`.
#[derive(Debug, Args)]
pub struct SideArgs {
    /// The scene.
    pub scene: PathBuf,
    /// The view, by name or id.
    #[arg(long)]
    pub view: Option<String>,
    /// Sizes of the inference.
    #[arg(long)]
    pub size: Size,
    /// Who infers.
    #[arg(long, value_enum)]
    pub side: Side,
    /// Threads of an inference.
    #[arg(long)]
    pub threads: usize,
    /// The weights.
    #[arg(long)]
    pub weights: Option<PathBuf>,
}

/// Who infers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Side {
    /// libtorch, as the public implementations use it; every image's features are computed for every view.
    Plain,
    /// Ours in the middle of a scene: the features of the reference image are new, those of the sources are known.
    Ours,
    /// Ours for a view alone: no features are known.
    Alone,
}

impl Side {
    /// As the command line has it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Ours => "ours",
            Self::Alone => "alone",
        }
    }
}

/// Sizes of an inference: `1152x864x192x5` is width, height, depths and views.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Size {
    pub width: usize,
    pub height: usize,
    pub depths: usize,
    pub views: usize,
}

impl Size {
    /// As the network's crate has it.
    pub fn infer_size(self, refined: bool) -> InferSize {
        let Self { width, height, depths, views } = self;
        InferSize { width, height, depths, views, refined }
    }
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = match text {
            "small" => "640x512x192x3",
            "medium" => "1152x864x192x5",
            "dtu" => "1600x1184x256x5",
            "tnt" => "1920x1056x256x5",
            other => other,
        };
        let numbers: Vec<usize> = text.split('x').filter_map(|number| number.parse().ok()).collect();
        match numbers[..] {
            [width, height, depths, views]
                if (32..=16384).contains(&width)
                    && (32..=16384).contains(&height)
                    && (8..=4096).contains(&depths)
                    && (2..=32).contains(&views) =>
            {
                Ok(Self { width, height, depths, views })
            }
            _ => {
                Err(format!("{text} is no size; write it like 1152x864x192x5 (width, height, depths, views)"))
            }
        }
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}x{}x{}", self.width, self.height, self.depths, self.views)
    }
}

/// What a side is asked, as a line of JSON.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Request {
    /// Infer, and say what it cost (a [`Run`]).
    Run,
    /// Write the depth map of the first run to this PFM file.
    SaveDepth(PathBuf),
    /// Write what is inferred from into this folder, for another implementation.
    Export(PathBuf),
}

/// What one inference cost.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Run {
    /// From images in memory to the depth map.
    pub seconds: f64,
    /// Where they went.
    pub stages: Vec<Stage>,
    /// The most memory the process had during the inference.
    pub peak_bytes: u64,
    /// The memory it had before.
    pub before_bytes: u64,
    /// How much more than that is predicted, for ours.
    pub predicted_bytes: Option<u64>,
    /// Whether the weights refine.
    pub refined: bool,
}

/// A part of an inference.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Stage {
    /// What it does.
    pub name: String,
    /// How long that took.
    pub seconds: f64,
    /// Floating-point operations, as the plain network counts them.
    pub operations: f64,
}

/// Answers requests until standard input ends.
pub fn run(args: &SideArgs) -> Result<Outcome> {
    let mut bench = Bench::load(args)?;
    for line in stdin().lines() {
        let line = line.context("cannot read a request")?;
        let request = serde_json::from_str(&line).with_context(|| format!("\"{line}\" is no request"))?;
        let answer = match request {
            Request::Run => serde_json::to_string(&bench.run()?).context("cannot write figures")?,
            Request::SaveDepth(path) => {
                let first = bench.first.as_ref().context("nothing has been inferred yet")?;
                write_pfm(&path, &first.depth)?;
                "{}".to_owned()
            }
            Request::Export(folder) => {
                bench.export(&folder)?;
                "{}".to_owned()
            }
        };
        writeln!(stdout(), "{answer}").context("cannot answer")?;
        stdout().flush().context("cannot answer")?;
    }
    Ok(Outcome { text: String::new(), value: serde_json::Value::Null, skipped_views: false })
}

/// A loaded view and who infers it.
struct Bench {
    size: Size,
    side: Side,
    threads: usize,
    weights: Weights,
    backend: Backend,
    view: ViewPlan,
    /// The reference first.
    images: Vec<WorkingImage>,
    runs: usize,
    first: Option<DepthMap>,
}

enum Backend {
    Plain(Box<TorchBackend>),
    Ours(Box<CpuBackend>),
}

impl Bench {
    fn load(args: &SideArgs) -> Result<Self> {
        let SideArgs { size, side, threads, .. } = *args;
        let scene = input::read(&args.scene, &ReadOptions::default())?.scene;
        let options = PlanOptions {
            views: size.views as u32,
            depths: Some(size.depths as u32),
            // What the public implementations know.
            sampling: SamplingChoice::Uniform,
            ..PlanOptions::default()
        };
        let plan = plan(&scene, &options);
        let view = match &args.view {
            Some(name) => find(&scene, &plan, name)?,
            None => {
                plan.views.iter().max_by_key(|view| view.sources.len()).context("no view can be inferred")?
            }
        };
        anyhow::ensure!(
            view.sources.len() + 1 == size.views,
            "no view of the scene has {} sources",
            size.views - 1
        );
        let mut images = Vec::new();
        for id in std::iter::once(&view.view).chain(&view.sources) {
            let view = &scene.views[id];
            let (width, height) = (size.width as u32, size.height as u32);
            let pixels = read_image(&view.image)?;
            images.push(WorkingImage::prepare(pixels, &view.camera, &view.distortion, width, height)?);
        }
        let weights = match &args.weights {
            Some(path) => read_weights(path)?.1,
            None => Weights::seeded(WeightsMetadata::untrained(Refinement::None), 1),
        };
        let backend = match side {
            Side::Plain => Backend::Plain(Box::new(TorchBackend::as_published(&weights, threads)?)),
            Side::Ours | Side::Alone => Backend::Ours(our_backend(&weights, threads)?),
        };
        Ok(Self { size, side, threads, weights, backend, view: view.clone(), images, runs: 0, first: None })
    }

    fn run(&mut self) -> Result<Run> {
        match self.side {
            Side::Plain => {}
            // One that knows nothing.
            Side::Alone => self.backend = Backend::Ours(our_backend(&self.weights, self.threads)?),
            // Another pixel makes it another image, whose features are not known.
            Side::Ours => {
                let byte = &mut self.images[0].pixels.values_mut()[0][0];
                *byte = byte.wrapping_add(u8::from(self.runs > 0));
            }
        }
        let sources: Vec<&WorkingImage> = self.images[1..].iter().collect();
        let input =
            InferInput { reference: &self.images[0], sources: &sources, hypotheses: &self.view.hypotheses };
        let before_bytes = resident_bytes("VmRSS:");
        forget_peak();
        let begun = Instant::now();
        let map = match &mut self.backend {
            Backend::Plain(backend) => backend.infer(input)?,
            Backend::Ours(backend) => backend.infer(input)?,
        };
        let seconds = begun.elapsed().as_secs_f64();
        let peak_bytes = resident_bytes("VmHWM:");
        let refined = self.weights.metadata().refinement != Refinement::None;
        let size = self.size.infer_size(refined);
        let new_images = if self.side == Side::Ours && self.runs > 0 { 1 } else { self.size.views };
        let (stages, predicted_bytes) = match &self.backend {
            Backend::Plain(backend) => (plain_stages(backend.times(), size), None),
            Backend::Ours(backend) => {
                (our_stages(backend.times(), size, new_images), Some(backend.predict(size).bytes))
            }
        };
        self.runs += 1;
        self.first.get_or_insert(map);
        Ok(Run { seconds, stages, peak_bytes, before_bytes, predicted_bytes, refined })
    }

    /// Writes `input.safetensors`: `images` (views, rows, columns, RGB bytes), `projections` (views, 3, 4; from the
    /// world to pixels of the features) and `depths`; and `weights.safetensors`. The reference comes first.
    fn export(&self, folder: &Path) -> Result<()> {
        fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
        let mut pixels = Vec::new();
        let mut projections = Vec::new();
        for image in &self.images {
            pixels.extend_from_slice(image.pixels.values().as_flattened());
            let camera = image.camera;
            let projection =
                planesweep_scene::Camera { intrinsics: camera.intrinsics.quartered(), ..camera }.projection();
            for row in projection.row_iter() {
                projections.extend(row.iter().flat_map(|value| value.to_le_bytes()));
            }
        }
        let depths: Vec<u8> =
            self.view.hypotheses.depths().iter().flat_map(|depth| depth.to_le_bytes()).collect();
        let Size { width, height, depths: count, views } = self.size;
        let tensors = [
            ("images", TensorView::new(Dtype::U8, vec![views, height, width, 3], &pixels)?),
            ("projections", TensorView::new(Dtype::F64, vec![views, 3, 4], &projections)?),
            ("depths", TensorView::new(Dtype::F64, vec![count], &depths)?),
        ];
        let path = folder.join("input.safetensors");
        safetensors::serialize_to_file(tensors, None, &path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        let path = folder.join("weights.safetensors");
        fs::write(&path, self.weights.to_bytes()).with_context(|| format!("cannot write {}", path.display()))
    }
}

fn our_backend(weights: &Weights, threads: usize) -> Result<Box<CpuBackend>> {
    Ok(Box::new(CpuBackend::new(weights, threads, None)?))
}

fn stage(name: &str, time: Duration, operations: f64) -> Stage {
    Stage { name: name.to_owned(), seconds: time.as_secs_f64(), operations }
}

fn plain_stages(times: PlainTimes, size: InferSize) -> Vec<Stage> {
    let operations = size.operations();
    let network = operations.first_layer + operations.middle_layers + operations.last_layer;
    vec![
        stage("features", times.features, operations.features),
        stage("warp, variance", times.cost, operations.warp),
        stage("3D network", times.regularization, network),
        stage("softmax, regression", times.regression, operations.refinement),
    ]
}

fn our_stages(times: InferTimes, size: InferSize, new_images: usize) -> Vec<Stage> {
    let operations = size.operations();
    let features = operations.features * new_images as f64 / size.views as f64;
    let mut stages = vec![
        stage("features", times.features, features),
        stage("warp, variance, first layer", times.cost, operations.warp + operations.first_layer),
        stage("middle layers", times.regularization, operations.middle_layers),
        stage("last layer, softmax, regression", times.regression, operations.last_layer),
    ];
    if size.refined {
        stages.push(stage("refinement", times.refinement, operations.refinement));
    }
    stages
}

/// A line of the kernel's record of this process, in bytes; 0 where there is none.
fn resident_bytes(name: &str) -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix(name));
    line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok()).unwrap_or(0) << 10
}

/// Makes the kernel count the peak from now on; where it does not, peaks include what came before.
fn forget_peak() {
    let _ = fs::write("/proc/self/clear_refs", "5");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_four_numbers_or_a_name() {
        let size = Size { width: 1152, height: 864, depths: 192, views: 5 };
        assert_eq!("medium".parse(), Ok(size));
        assert_eq!(size.to_string().parse(), Ok(size));
        for wrong in ["1152x864", "1152x864x192x1", "axbxcxd", "", "1152x864x192x5x6", "1152x864x0x5"] {
            assert!(wrong.parse::<Size>().is_err(), "{wrong}");
        }
    }
}
