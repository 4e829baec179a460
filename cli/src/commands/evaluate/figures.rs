//! What a measurement leaves on disk: plots, clouds coloured by error, the figures as JSON.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use nalgebra::Point3;
use planesweep_fusion::{PlyWriter, Point, VertexFormat};
use planesweep_report::{LinePlot, draw_lines, encode_png, error_color};
use planesweep_scene::write_atomically;
use serde_json::Value;

/// A folder for figures.
pub struct Figures {
    folder: PathBuf,
}

impl Figures {
    /// Makes the folder.
    pub fn create(folder: &Path) -> Result<Self> {
        fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
        Ok(Self { folder: folder.to_owned() })
    }

    /// Writes `NAME.png`.
    pub fn plot(&self, name: &str, plot: &LinePlot<'_>) -> Result<()> {
        self.write(&format!("{name}.png"), &encode_png(&draw_lines(plot))?)
    }

    /// Writes `NAME.ply`: points coloured by their distance, from white at none to dark red at `limit`.
    pub fn cloud(&self, name: &str, points: &[(Point3<f64>, f64)], limit: f64) -> Result<()> {
        let mut writer =
            PlyWriter::create(&self.folder.join(format!("{name}.ply")), VertexFormat::default())?;
        for chunk in points.chunks(1 << 16) {
            let colored: Vec<Point> = chunk
                .iter()
                .map(|(position, distance)| Point {
                    position: (*position).into(),
                    normal: [0.0; 3],
                    color: error_color((distance / limit) as f32),
                    confidence: 0.0,
                    views: 0,
                    seen_by: 0,
                })
                .collect();
            writer.write(&colored)?;
        }
        writer.finish()?;
        Ok(())
    }

    /// The outline of a histogram of distances from 0 to `end` in bars `width` wide: shares of all
    /// distances, in percent.
    pub fn histogram(distances: &mut dyn Iterator<Item = f64>, end: f64, width: f64) -> Vec<(f64, f64)> {
        let mut counts = vec![0_u64; (end / width).round() as usize];
        let mut total = 0_u64;
        for distance in distances {
            total += 1;
            if let Some(count) = counts.get_mut((distance / width) as usize) {
                *count += 1;
            }
        }
        let bars = counts.iter().enumerate();
        bars.flat_map(|(bar, count)| {
            let share = 100.0 * *count as f64 / total.max(1) as f64;
            [(bar as f64 * width, share), ((bar + 1) as f64 * width, share)]
        })
        .collect()
    }

    /// Writes `NAME.json`.
    pub fn json(&self, name: &str, value: &Value) -> Result<()> {
        self.write(&format!("{name}.json"), format!("{value:#}\n").as_bytes())
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let path = self.folder.join(name);
        write_atomically(&path, bytes).with_context(|| format!("cannot write {}", path.display()))
    }
}
