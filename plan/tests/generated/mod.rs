//! COLMAP models of any size, as a drone's flight over a field leaves them, written without ever being
//! in memory.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use image::RgbImage;

/// Photographs above the cells of a grid. Every point lies in the middle of a block of three by three
/// cells, and six of the nine cameras there see it.
pub struct Flight {
    /// Photographs along a side of the grid.
    pub side: u32,
    /// Points in each block.
    pub points_per_block: u64,
}

/// Distance between cameras and height of the flight, in scene units.
const STEP: f64 = 1.0;
const HEIGHT: f64 = 8.0;
const SIZE: (u32, u32) = (64, 48);
const FOCAL: f64 = 50.0;

impl Flight {
    pub fn views(&self) -> u64 {
        self.side as u64 * self.side as u64
    }

    fn blocks_per_side(&self) -> u64 {
        self.side as u64 - 2
    }

    fn blocks(&self) -> u64 {
        self.blocks_per_side() * self.blocks_per_side()
    }

    pub fn points(&self) -> u64 {
        self.blocks() * self.points_per_block
    }

    pub fn observations(&self) -> u64 {
        6 * self.points()
    }

    /// Writes `sparse/*.bin` and `images/` below `root`.
    pub fn write(&self, root: &Path) -> io::Result<()> {
        fs::create_dir_all(root.join("sparse"))?;
        fs::create_dir_all(root.join("images"))?;
        let first = root.join("images").join(name(0));
        RgbImage::new(SIZE.0, SIZE.1).save(&first).map_err(io::Error::other)?;
        for view in 1..self.views() {
            fs::hard_link(&first, root.join("images").join(name(view)))?;
        }
        let create = |file: &str| File::create(root.join("sparse").join(file)).map(BufWriter::new);
        let mut cameras = create("cameras.bin")?;
        put(&mut cameras, &[1])?;
        cameras.write_all(&[1_u32, 1].map(u32::to_le_bytes).concat())?;
        put(&mut cameras, &[SIZE.0 as u64, SIZE.1 as u64])?;
        let centre = (SIZE.0 as f64 / 2.0, SIZE.1 as f64 / 2.0);
        floats(&mut cameras, &[FOCAL, FOCAL, centre.0, centre.1])?;
        cameras.flush()?;
        self.write_images(&mut create("images.bin")?)?;
        self.write_points(&mut create("points3D.bin")?)
    }

    fn write_images(&self, file: &mut impl Write) -> io::Result<()> {
        put(file, &[self.views()])?;
        for view in 0..self.views() {
            file.write_all(&(view as u32 + 1).to_le_bytes())?;
            // Looks down: x stays, y and z turn; t = -R c.
            let (x, y) = self.above(view);
            floats(file, &[0.0, 1.0, 0.0, 0.0, -x, y, HEIGHT])?;
            file.write_all(&1_u32.to_le_bytes())?;
            file.write_all(name(view).as_bytes())?;
            file.write_all(&[0])?;
            let mut observations = Vec::new();
            // In the order of point ids, as the points count them.
            for k in 0..self.points_per_block {
                for block in self.blocks_around(view) {
                    if self.seen_by(block, k).any(|seen| seen == view) {
                        observations.push(self.point(block, k));
                    }
                }
            }
            put(file, &[observations.len() as u64])?;
            for (id, [px, py, pz]) in observations {
                let depth = HEIGHT - pz;
                let u = FOCAL * (px - x) / depth + SIZE.0 as f64 / 2.0;
                let v = FOCAL * (y - py) / depth + SIZE.1 as f64 / 2.0;
                floats(file, &[u, v])?;
                put(file, &[id])?;
            }
        }
        file.flush()
    }

    fn write_points(&self, file: &mut impl Write) -> io::Result<()> {
        let mut counts = vec![0_u32; self.views() as usize];
        put(file, &[self.points()])?;
        for k in 0..self.points_per_block {
            for block in 0..self.blocks() {
                let (id, position) = self.point(block, k);
                put(file, &[id])?;
                floats(file, &position)?;
                file.write_all(&[128; 3])?;
                floats(file, &[0.5])?;
                put(file, &[6])?;
                for view in self.seen_by(block, k) {
                    let count = &mut counts[view as usize];
                    file.write_all(&(view as u32 + 1).to_le_bytes())?;
                    file.write_all(&count.to_le_bytes())?;
                    *count += 1;
                }
            }
        }
        file.flush()
    }

    /// Where a camera stands.
    fn above(&self, view: u64) -> (f64, f64) {
        ((view % self.side as u64) as f64 * STEP, (view / self.side as u64) as f64 * STEP)
    }

    /// The blocks whose nine cells hold the camera's.
    fn blocks_around(&self, view: u64) -> impl Iterator<Item = u64> {
        let (side, blocks) = (self.side as u64, self.blocks_per_side());
        let span = move |at: u64| at.saturating_sub(2)..=at.min(blocks - 1);
        let (x, y) = (view % side, view / side);
        span(y).flat_map(move |row| span(x).map(move |column| row * blocks + column))
    }

    /// Six of the nine cameras of a block.
    fn seen_by(&self, block: u64, k: u64) -> impl Iterator<Item = u64> {
        let (side, blocks) = (self.side as u64, self.blocks_per_side());
        let (column, row) = (block % blocks, block / blocks);
        let left_out = [k % 9, (k + 4) % 9, (k + 7) % 9];
        (0..9)
            .filter(move |cell| !left_out.contains(cell))
            .map(move |cell| (row + cell / 3) * side + column + cell % 3)
    }

    /// Id and position (world) of a point.
    fn point(&self, block: u64, k: u64) -> (u64, [f64; 3]) {
        let blocks = self.blocks_per_side();
        let id = k * self.blocks() + block;
        // Digits of a hash scatter the points and give them some relief.
        let hash = id.wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let digit = |shift: u32| ((hash >> shift) & 0xffff) as f64 / 65536.0 - 0.5;
        let middle = |at: u64| (at as f64 + 1.0) * STEP;
        let x = middle(block % blocks) + digit(0);
        let y = middle(block / blocks) + digit(16);
        (id + 1, [x, y, digit(32)])
    }
}

fn name(view: u64) -> String {
    format!("{view:06}.png")
}

fn put(file: &mut impl Write, values: &[u64]) -> io::Result<()> {
    values.iter().try_for_each(|value| file.write_all(&value.to_le_bytes()))
}

fn floats(file: &mut impl Write, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|value| file.write_all(&value.to_le_bytes()))
}
