//! `report.html`: one file that needs no other.

use std::collections::BTreeMap;
use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use planesweep_scene::{Raster, Sampling, ViewId};
use serde_json::Value;

use crate::depth_histogram::plot_depth_histogram;
use crate::picture::{PictureError, encode_jpeg, shrunk};
use crate::{Funnel, Loss, RunReport, ViewReport};

/// The pictures of a report. They are embedded as JPEG, reduced where they are wider than the page
/// can show, so that a report of hundreds of views still opens.
#[derive(Clone, Debug, Default)]
pub struct Pictures {
    /// The cloud.
    pub cloud: Option<Raster<[u8; 3]>>,
    /// Previews of views; not every view needs one.
    pub previews: BTreeMap<ViewId, Raster<[u8; 3]>>,
    /// Depths (z, scene units) of the sparse points that views see, drawn against their ranges.
    pub sparse_depths: BTreeMap<ViewId, Vec<f64>>,
}

/// Pictures of twice this width are halved.
const PICTURE_WIDTH: usize = 1100;

/// Writes the page. Whatever the report contains, names included, appears as text, never as markup.
pub fn render_html(report: &RunReport, pictures: &Pictures) -> Result<String, PictureError> {
    let mut page = String::new();
    push(
        &mut page,
        format_args!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{scene} – planesweep</title>\n<style>\n{css}</style>\n</head>\n<body>\n<main>\n\
             <h1>{scene}</h1>\n<p class=\"soft\">dense reconstruction by planesweep</p>\n",
            scene = escape(&report.scene),
            css = include_str!("report.css"),
        ),
    );
    push_figures(&mut page, report);
    push_warnings(&mut page, &report.warnings);
    if let Some(cloud) = &pictures.cloud {
        push(&mut page, format_args!("{}", image(cloud, "The point cloud")?));
    }
    push(&mut page, format_args!("<div class=\"columns\">\n<div>\n<h2>Pixels of all views</h2>\n"));
    push(&mut page, format_args!("<div class=\"card\">{}</div>\n</div>\n", funnel_bars(&report.funnel())));
    push(&mut page, format_args!("<div>\n<h2>Stages</h2>\n<div class=\"card\">"));
    let longest = report.stages.iter().map(|stage| stage.seconds).fold(0.0, f64::max);
    let stages =
        report.stages.iter().map(|s| (s.name.as_str(), share(s.seconds, longest), duration(s.seconds)));
    push(&mut page, format_args!("{}</div>\n</div>\n</div>\n", bars(stages)));
    push_losses(&mut page, &report.funnel());

    push_skipped(&mut page, report);
    push(&mut page, format_args!("<h2>Views</h2>\n"));
    for view in &report.views {
        push_view(&mut page, view, pictures)?;
    }
    push(&mut page, format_args!("<div class=\"columns\">\n<div>\n<h2>Settings</h2>\n"));
    push_table(&mut page, report.settings.iter().map(|(name, value)| (name.as_str(), plain(value))));
    push(&mut page, format_args!("</div>\n<div>\n<h2>Versions</h2>\n"));
    push_table(&mut page, report.versions.iter().map(|(name, value)| (name.as_str(), value.clone())));
    push(&mut page, format_args!("</div>\n</div>\n</main>\n</body>\n</html>\n"));
    Ok(page)
}

fn push_figures(page: &mut String, report: &RunReport) {
    let views = report.views.len() as u64;
    let figures = [
        (grouped(report.totals.points), "points".to_owned()),
        (grouped(views), "views".to_owned()),
        (grouped(report.skipped.len() as u64), "views skipped".to_owned()),
        (duration(report.totals.wall_seconds), report.totals.span()),
    ];
    push(page, format_args!("<div class=\"figures\">\n"));
    for (figure, what) in figures {
        push(
            page,
            format_args!("<div class=\"card\"><b>{figure}</b><span class=\"soft\">{what}</span></div>\n"),
        );
    }
    push(page, format_args!("</div>\n"));
}

fn push_skipped(page: &mut String, report: &RunReport) {
    if report.skipped.is_empty() {
        return;
    }
    push(page, format_args!("<h2>Skipped views</h2>\n"));
    push_table(page, report.skipped.iter().map(|view| (view.name.as_str(), view.reason.clone())));
}

fn push_view(page: &mut String, view: &ViewReport, pictures: &Pictures) -> Result<(), PictureError> {
    let sampling = match view.sampling {
        Sampling::Uniform => "uniform",
        Sampling::Inverse => "inverse",
    };
    let name = escape(&view.name);
    push(
        page,
        format_args!(
            "<section class=\"card\">\n<div class=\"head\"><h3>{name}</h3><span class=\"soft\">view {id} · \
             {width}×{height} · depth {min:.4} to {max:.4}, {count} planes, {sampling} · {seconds}</span></div>\n",
            id = view.id,
            width = view.width,
            height = view.height,
            min = view.depth_min,
            max = view.depth_max,
            count = view.depth_count,
            seconds = duration(view.seconds),
        ),
    );
    push_warnings(page, &view.warnings);
    if let Some(depths) = pictures.sparse_depths.get(&view.id) {
        push(page, format_args!("{}", plot_depth_histogram(depths, view.depth_min, view.depth_max)));
    }
    if let Some(preview) = pictures.previews.get(&view.id) {
        push(page, format_args!("{}", image(preview, &view.name)?));
    }
    push(
        page,
        format_args!(
            "{}\n<p class=\"soft\">sources: {}</p>\n</section>\n",
            funnel_bars(&view.funnel),
            escape(&view.sources.join(", ")),
        ),
    );
    Ok(())
}

/// What each step dropped, why, and what to do; the largest loss stands out.
fn push_losses(page: &mut String, funnel: &Funnel) {
    push(page, format_args!("<h2>What was dropped</h2>\n<div class=\"card\"><table>\n"));
    for Loss { step, pixels, is_largest, reason, advice } in funnel.losses() {
        let share = 100.0 * share(pixels as f64, funnel.pixels as f64);
        let step = if is_largest { format!("{step} (the largest loss)") } else { step.to_owned() };
        push(
            page,
            format_args!(
                "<tr><th>{}</th><td>{} pixels, {share:.1} %: {}.<br><span class=\"soft\">{}.</span></td></tr>\n",
                escape(&step),
                grouped(pixels),
                escape(reason),
                escape(advice),
            ),
        );
    }
    push(page, format_args!("</table></div>\n"));
}

fn push_warnings(page: &mut String, warnings: &[String]) {
    for warning in warnings {
        push(page, format_args!("<p class=\"warning\">{}</p>\n", escape(warning)));
    }
}

fn push_table<'a>(page: &mut String, rows: impl Iterator<Item = (&'a str, String)>) {
    push(page, format_args!("<div class=\"card\"><table>\n"));
    for (name, value) in rows {
        push(page, format_args!("<tr><th>{}</th><td>{}</td></tr>\n", escape(name), escape(&value)));
    }
    push(page, format_args!("</table></div>\n"));
}

fn funnel_bars(funnel: &Funnel) -> String {
    let all = funnel.pixels as f64;
    bars(funnel.steps().into_iter().map(|(name, count)| {
        let share = share(count as f64, all);
        (name, share, format!("{} · {:.1} %", grouped(count), 100.0 * share))
    }))
}

/// Rows of name, bar and figure; bars are shares of the widest possible.
fn bars<'a>(rows: impl Iterator<Item = (&'a str, f64, String)>) -> String {
    const ROW: usize = 22;
    let rows: Vec<_> = rows.collect();
    let mut svg = format!("<svg viewBox=\"0 0 460 {}\" role=\"img\">", (rows.len() * ROW).max(1));
    for (index, (name, share, figure)) in rows.into_iter().enumerate() {
        let (top, base) = (index * ROW + 5, index * ROW + 15);
        push(
            &mut svg,
            format_args!(
                "<text class=\"name\" x=\"0\" y=\"{base}\">{name}</text>\
                 <rect class=\"track\" x=\"124\" y=\"{top}\" width=\"190\" height=\"12\" rx=\"3\"/>\
                 <rect class=\"bar\" x=\"124\" y=\"{top}\" width=\"{width:.1}\" height=\"12\" rx=\"3\"/>\
                 <text x=\"326\" y=\"{base}\">{figure}</text>",
                name = escape(name),
                width = 190.0 * share,
                figure = escape(&figure),
            ),
        );
    }
    svg.push_str("</svg>");
    svg
}

fn image(picture: &Raster<[u8; 3]>, description: &str) -> Result<String, PictureError> {
    let factor = (picture.width() / PICTURE_WIDTH).max(1);
    let bytes = if factor > 1 { encode_jpeg(&shrunk(picture, factor))? } else { encode_jpeg(picture)? };
    Ok(format!(
        "<img loading=\"lazy\" alt=\"{}\" src=\"data:image/jpeg;base64,{}\">\n",
        escape(description),
        STANDARD.encode(bytes)
    ))
}

/// A part of a whole, 0 when there is no whole.
fn share(part: f64, whole: f64) -> f64 {
    if whole > 0.0 { (part / whole).clamp(0.0, 1.0) } else { 0.0 }
}

/// Strings without their quotes, everything else as JSON has it.
fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// With a thin space between groups of three digits.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}

fn duration(seconds: f64) -> String {
    let whole = seconds.max(0.0).round() as u64;
    match whole {
        0..10 => format!("{seconds:.2} s"),
        10..120 => format!("{seconds:.1} s"),
        120..7200 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

/// Text that means itself in HTML, in elements and in quoted attributes.
fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            other => escaped.push(other),
        }
    }
    escaped
}

fn push(page: &mut String, text: std::fmt::Arguments) {
    page.write_fmt(text).expect("writing to a string cannot fail");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_report::tests::sample;

    #[test]
    fn names_are_text_and_never_markup() {
        let mut report = sample();
        let evil = "<script>alert(\"x\")</script>' & co.jpg";
        report.scene = evil.into();
        report.views[0].name = evil.into();
        report.views[0].sources = vec![evil.into()];
        report.views[0].warnings = vec![evil.into()];
        report.skipped[0].reason = evil.into();
        report.stages[0].name = evil.into();
        report.settings.insert(evil.into(), Value::from(evil));
        report.versions.insert(evil.into(), evil.into());
        report.warnings.push(evil.into());
        let previews = BTreeMap::from([(report.views[0].id, Raster::filled(8, 8, [1; 3]))]);
        let page = render_html(&report, &Pictures { previews, ..Pictures::default() }).expect("drawn");
        assert!(!page.contains("<script"));
        assert_eq!(
            page.matches("&lt;script&gt;alert(&quot;x&quot;)&lt;/script&gt;&#39; &amp; co.jpg").count(),
            13
        );
    }

    #[test]
    fn the_page_holds_all_it_needs() {
        let report = sample();
        let pictures = Pictures {
            cloud: Some(Raster::filled(40, 30, [90; 3])),
            previews: report.views.iter().map(|v| (v.id, Raster::filled(2400, 10, [50; 3]))).collect(),
            sparse_depths: BTreeMap::from([(report.views[0].id, vec![report.views[0].depth_min])]),
        };
        let page = render_html(&report, &pictures).expect("drawn");
        assert_eq!(page.matches("src=\"data:image/jpeg;base64,").count(), 3);
        assert!(!page.contains("http"), "nothing is fetched");
        assert_eq!(page.matches("<title>sparse points").count(), 1);
        for part in ["54\u{202f}600", "lonely.jpg", "min_confidence", "2 min 24 s", "80.4 %"] {
            assert!(page.contains(part), "{part} is missing");
        }
        let opened = page.matches("<div").count() + page.matches("<section").count();
        let closed = page.matches("</div>").count() + page.matches("</section>").count();
        assert_eq!(opened, closed);
    }

    #[test]
    fn an_empty_report_is_a_page() {
        let page = render_html(&RunReport::default(), &Pictures::default()).expect("drawn");
        assert!(page.ends_with("</html>\n") && !page.contains("NaN"));
    }

    #[test]
    fn figures_are_readable() {
        assert_eq!(grouped(1_234_567), "1\u{202f}234\u{202f}567");
        assert_eq!(grouped(12), "12");
        let times = [0.034, 61.26, 754.0, 10_000.0].map(duration);
        assert_eq!(times, ["0.03 s", "61.3 s", "12 min 34 s", "2 h 46 min"]);
    }
}
