//! What a benchmark runs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use planesweep_evaluate::dtu::TEST_SCANS;
use serde::Deserialize;

/// A benchmark's file. Relative paths in it are relative to its folder.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub struct BenchmarkConfig {
    /// Which benchmark; it decides the scenes, the settings of the paper and the metric.
    pub preset: Preset,
    /// The folder with a folder per scene: `Family/`, or `scan1/`.
    pub scenes: PathBuf,
    /// The ground truth: for Tanks and Temples a folder with a folder per scene, for DTU its own folder.
    /// Without it the scenes are only reconstructed.
    pub truth: Option<PathBuf>,
    /// Where the results go: a folder per scene, and the tables.
    pub out: PathBuf,
    /// The weights; by default those that `reconstruct` takes by itself.
    pub weights: Option<PathBuf>,
    /// Another list of scenes than the preset's.
    pub names: Option<Vec<String>>,
    /// Further options of `reconstruct` (of `submit`, with a coordinator); they override the preset's.
    #[serde(default)]
    pub options: Vec<String>,
    /// Thresholds of scenes that the benchmark sets none for, in metres.
    #[serde(default)]
    pub thresholds: BTreeMap<String, f64>,
    /// The clouds are in the frame of the scans already.
    #[serde(default)]
    pub aligned: bool,
}

/// The benchmarks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// The eight scenes of the paper's table 2, whose scans are not public.
    TanksAndTemplesIntermediate,
    /// The seven scenes with public scans.
    TanksAndTemplesTraining,
    /// The 22 scans of the paper's table 1.
    Dtu,
}

impl BenchmarkConfig {
    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self> {
        let text =
            std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let mut config: Self =
            toml::from_str(&text).with_context(|| format!("cannot understand {}", path.display()))?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let paths = [&mut config.scenes, &mut config.out];
        for path in paths.into_iter().chain(&mut config.truth).chain(&mut config.weights) {
            *path = folder.join(&path);
        }
        Ok(config)
    }

    /// The names of the scenes.
    pub fn names(&self) -> Vec<String> {
        let given = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        match (&self.names, self.preset) {
            (Some(names), _) => names.clone(),
            (None, Preset::TanksAndTemplesIntermediate) => given(&INTERMEDIATE),
            (None, Preset::TanksAndTemplesTraining) => given(&TRAINING),
            (None, Preset::Dtu) => TEST_SCANS.iter().map(|scan| format!("scan{scan}")).collect(),
        }
    }

    /// The arguments for a scene of `command`, `reconstruct` or `submit`; `more` go before the file's options.
    pub fn arguments(&self, name: &str, command: &str, more: &[String]) -> Vec<String> {
        let text = |path: &Path| path.to_string_lossy().into_owned();
        let settings: &[&str] = match self.preset {
            // N = 5, W = 1920, D = 256; ranges from the sparse points (paper, section 5.2).
            Preset::TanksAndTemplesIntermediate | Preset::TanksAndTemplesTraining => {
                &["--views", "5", "--max-size", "1920", "--depths", "256"]
            }
            // N = 5, W = 1600, D = 256 from 425 mm to 935 mm, uniform (paper, sections 4.1 and 5.1).
            Preset::Dtu => &[
                "--views",
                "5",
                "--max-size",
                "1600",
                "--depths",
                "256",
                "--depth-range",
                "425,935",
                "--sampling",
                "uniform",
            ],
        };
        let mut arguments = vec!["planesweep".to_owned(), command.to_owned()];
        arguments.extend([text(&self.scenes.join(name)), "--out".to_owned(), text(&self.out.join(name))]);
        arguments.extend(settings.iter().map(|word| (*word).to_owned()));
        arguments.extend(self.weights.iter().flat_map(|path| ["--weights".to_owned(), text(path)]));
        arguments.extend(more.iter().chain(&self.options).cloned());
        arguments
    }
}

/// In the order of the paper's table 2.
pub const INTERMEDIATE: [&str; 8] =
    ["Family", "Francis", "Horse", "Lighthouse", "M60", "Panther", "Playground", "Train"];
const TRAINING: [&str; 7] =
    ["Barn", "Caterpillar", "Church", "Courthouse", "Ignatius", "Meetingroom", "Truck"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_relative_to_the_file_and_options_come_last() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("dtu.toml");
        let text =
            "preset = \"dtu\"\nscenes = \"scans\"\nout = \"/results\"\noptions = [\"--depths\", \"64\"]\n";
        std::fs::write(&path, text).expect("written");
        let config = BenchmarkConfig::read(&path).expect("a benchmark");
        assert_eq!(config.scenes, folder.path().join("scans"));
        assert_eq!((config.names().len(), config.names()[0].as_str()), (22, "scan1"));
        let arguments = config.arguments("scan1", "reconstruct", &[]);
        assert!(arguments.contains(&"/results/scan1".to_owned()));
        assert_eq!(arguments[arguments.len() - 2..], ["--depths", "64"]);
    }

    #[test]
    fn unknown_settings_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("b.toml");
        std::fs::write(&path, "preset = \"dtu\"\nscenes = \"a\"\nout = \"b\"\nthreshold = 3\n")
            .expect("written");
        assert!(format!("{:#}", BenchmarkConfig::read(&path).expect_err("refused")).contains("threshold"));
    }
}
