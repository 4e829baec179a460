//! What a person sees of a run: a preview per view, a picture of the cloud, `report.json` and a
//! self-contained `report.html`.
//!
//! All of it is computed from plain values and returned as values; writing files is the caller's.

#![warn(missing_docs)]

mod cloud_picture;
mod colormap;
mod depth_histogram;
mod event_file;
mod font;
mod html;
mod line_plot;
mod losses;
mod picture;
mod preview;
mod probability_plot;
mod run_report;

pub use cloud_picture::render_cloud;
pub use colormap::{confidence_color, depth_color, error_color};
pub use depth_histogram::plot_depth_histogram;
pub use event_file::{event_file_start, scalar_event};
pub use html::{Pictures, render_html};
pub use line_plot::{Line, LinePlot, draw_lines};
pub use losses::Loss;
pub use picture::{PictureError, encode_png};
pub use preview::{PreviewError, PreviewOptions, draw_preview};
pub use probability_plot::plot_probability;
pub use run_report::{Funnel, RunReport, SkippedView, StageReport, Totals, ViewReport};
