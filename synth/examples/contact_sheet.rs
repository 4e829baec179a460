//! Training samples to look at: `cargo run -p planesweep-synth --example contact_sheet -- OUT.png
//! FIRST_SEED COUNT [SETTING or any] [FOLDER...]` writes one row per sample: its views, then depth within its range (near
//! is bright, unknown is blue), two samples side by side.

use std::error::Error;
use std::time::Instant;

use image::{Rgb, RgbImage};
use planesweep_scene::TrainingSample;
use planesweep_synth::{Library, TrainingOptions, training_sample_with};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let mut next = || arguments.next();
    let out = next().ok_or("the PNG to write is missing")?;
    let first: u64 = next().map_or(Ok(0), |text| text.parse())?;
    let count: u64 = next().map_or(Ok(12), |text| text.parse())?;
    let setting = next().filter(|name| name != "any");
    let setting = setting.map(|name| serde_json::from_value(name.into())).transpose()?;
    let mut library = Library::default();
    while let Some(folder) = next() {
        library.add_folder(folder.as_ref())?;
    }
    let options = TrainingOptions { setting, ..TrainingOptions::default() };
    let (width, height) = (options.width, options.height);
    let columns = options.views as u32 + 1;
    let mut sheet = RgbImage::new(2 * columns * width, count.div_ceil(2) as u32 * height);
    let start = Instant::now();
    for i in 0..count {
        let sample = training_sample_with(first + i, &options, &library);
        let (left, top) = ((i % 2) as u32 * columns * width, (i / 2) as u32 * height);
        for (k, view) in sample.views.iter().enumerate() {
            draw(&mut sheet, left + k as u32 * width, top, width, height, |x, y| view.pixels.at(x, y));
        }
        let x = left + sample.views.len() as u32 * width;
        draw(&mut sheet, x, top, width, height, |x, y| depth_color(&sample, x / 4, y / 4));
    }
    println!("{:.3} s a sample", start.elapsed().as_secs_f64() / count as f64);
    sheet.save(out)?;
    Ok(())
}

fn draw(
    sheet: &mut RgbImage,
    left: u32,
    top: u32,
    width: u32,
    height: u32,
    color: impl Fn(usize, usize) -> [u8; 3],
) {
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        sheet.put_pixel(left + x, top + y, Rgb(color(x as usize, y as usize)));
    }
}

/// Grey by inverse depth.
fn depth_color(sample: &TrainingSample, x: usize, y: usize) -> [u8; 3] {
    let depth = f64::from(sample.depth.at(x, y));
    if depth <= 0.0 {
        return [0, 0, 120];
    }
    if depth.is_infinite() {
        return [0, 110, 160];
    }
    let range = &sample.range;
    let share = (1.0 / depth - 1.0 / range.max) / (1.0 / range.min - 1.0 / range.max);
    [(share.clamp(0.0, 1.0) * 230.0 + 25.0) as u8; 3]
}
