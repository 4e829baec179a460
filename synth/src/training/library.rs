//! Scanned things and photographs that a user adds to the scenes.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use planesweep_scene::{ImageError, read_image};
use thiserror::Error;

use super::photo::Photo;
use crate::geometry::{Bounds, TriangleMesh};
use crate::mesh_file::{MeshError, is_mesh, read_mesh};

/// What scenes may use beside what they make up: nothing by default.
#[derive(Clone, Debug, Default)]
pub struct Library {
    pub(super) meshes: Vec<Arc<ScannedMesh>>,
    pub(super) photos: Vec<Arc<Photo>>,
}

/// A mesh with its own texture, if it has one.
#[derive(Debug)]
pub struct ScannedMesh {
    pub mesh: Arc<TriangleMesh>,
    pub texture: Option<Arc<Photo>>,
    /// Of the largest side of its box.
    pub size: f64,
    /// Of its box.
    pub middle: Vector3<f64>,
    /// Half the sides of its box.
    pub half: Vector3<f64>,
    /// See [`TriangleMesh::uv_per_length`].
    pub uv_per_length: f64,
}

/// Why a folder could not be used.
#[derive(Debug, Error)]
pub enum LibraryError {
    /// It could not be listed.
    #[error("cannot list the folder {}", path.display())]
    List {
        /// The folder.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A mesh could not be read.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// An image could not be read.
    #[error("cannot use {} as a texture", path.display())]
    Texture {
        /// The image.
        path: PathBuf,
        /// Why.
        #[source]
        source: ImageError,
    },
    /// Nothing in it is of use.
    #[error("found neither a mesh nor an image in {}", path.display())]
    Nothing {
        /// The folder.
        path: PathBuf,
    },
}

impl Library {
    /// Adds what a folder and the folders in it hold: meshes (PLY, OBJ, NPZ), each textured by the image
    /// of the same name beside it, and all other images as photographs for any surface. The order is
    /// that of the paths, so a folder gives the same scenes everywhere.
    pub fn add_folder(&mut self, folder: &Path) -> Result<(), LibraryError> {
        let mut files = Vec::new();
        list(folder, &mut files)?;
        files.sort();
        let meshes: Vec<&PathBuf> = files.iter().filter(|path| is_mesh(path)).collect();
        let images: Vec<&PathBuf> = files.iter().filter(|path| is_image(path)).collect();
        if meshes.is_empty() && images.is_empty() {
            return Err(LibraryError::Nothing { path: folder.to_owned() });
        }
        let stem = |path: &Path| path.with_extension("");
        for path in &meshes {
            let own = images.iter().find(|image| stem(image) == stem(path));
            let texture = own.map(|image| photo(image)).transpose()?;
            self.meshes.push(Arc::new(ScannedMesh::new(read_mesh(path)?, texture)));
        }
        for path in images {
            if !meshes.iter().any(|mesh| stem(mesh) == stem(path)) {
                self.photos.push(photo(path)?);
            }
        }
        Ok(())
    }

    /// How many meshes and photographs there are.
    pub fn counts(&self) -> (usize, usize) {
        (self.meshes.len(), self.photos.len())
    }
}

impl ScannedMesh {
    fn new(mesh: TriangleMesh, texture: Option<Arc<Photo>>) -> Self {
        let nothing = Bounds { min: nalgebra::Point3::origin(), max: nalgebra::Point3::origin() };
        let Bounds { min, max } = mesh.bounds().unwrap_or(nothing);
        let half = (max - min) / 2.0;
        Self {
            uv_per_length: mesh.uv_per_length(),
            texture: texture.filter(|_| mesh.has_uv()),
            mesh: Arc::new(mesh),
            size: 2.0 * half.max(),
            middle: min.coords + half,
            half,
        }
    }

    /// How far the turned mesh reaches below its middle.
    pub fn reach_down(&self, rotation: &Matrix3<f64>) -> f64 {
        rotation.row(2).transpose().abs().dot(&self.half)
    }
}

fn list(folder: &Path, files: &mut Vec<PathBuf>) -> Result<(), LibraryError> {
    let failed = |source| LibraryError::List { path: folder.to_owned(), source };
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        // Links are not followed: they may lead in circles.
        let kind = entry.file_type().map_err(failed)?;
        if kind.is_dir() {
            list(&entry.path(), files)?;
        } else if kind.is_file() {
            files.push(entry.path());
        }
    }
    Ok(())
}

fn is_image(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    matches!(extension.as_str(), "jpg" | "jpeg" | "png" | "tif" | "tiff")
}

fn photo(path: &Path) -> Result<Arc<Photo>, LibraryError> {
    let image = read_image(path).map_err(|source| LibraryError::Texture { path: path.to_owned(), source })?;
    Ok(Arc::new(Photo::new(image)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Setting, TrainingOptions, training_sample, training_sample_with};

    #[test]
    fn a_folder_adds_textured_meshes_and_photographs_to_the_scenes() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let inner = folder.path().join("inner");
        fs::create_dir(&inner).expect("made");
        let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n\
                   f 1/1 3/3 2/2\nf 1/1 2/2 4/3\nf 1/1 4/3 3/2\nf 2/1 3/2 4/3\n";
        fs::write(inner.join("thing.obj"), obj).expect("written");
        for (name, value) in [("inner/thing.png", 200_u8), ("wall.png", 40)] {
            let pixels: Vec<u8> = (0..16 * 16 * 3).map(|i| value.wrapping_add(i as u8)).collect();
            image::save_buffer(folder.path().join(name), &pixels, 16, 16, image::ExtendedColorType::Rgb8)
                .expect("written");
        }
        fs::write(folder.path().join("notes.txt"), "not for us").expect("written");
        let mut library = Library::default();
        library.add_folder(folder.path()).expect("a library");
        assert_eq!(library.counts(), (1, 1));
        let scan = &library.meshes[0];
        assert!(scan.texture.is_some() && scan.size == 1.0 && scan.uv_per_length > 0.1);
        let options = TrainingOptions { width: 64, height: 48, views: 2, setting: Some(Setting::Objects) };
        let changed = (0..3)
            .any(|seed| training_sample_with(seed, &options, &library) != training_sample(seed, &options));
        assert!(changed, "the library is not used");
    }

    #[test]
    fn folders_without_use_and_damaged_files_are_named() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut library = Library::default();
        assert!(matches!(library.add_folder(folder.path()), Err(LibraryError::Nothing { .. })));
        assert!(matches!(library.add_folder(&folder.path().join("none")), Err(LibraryError::List { .. })));
        fs::write(folder.path().join("wall.png"), "no picture").expect("written");
        assert!(matches!(library.add_folder(folder.path()), Err(LibraryError::Texture { .. })));
        fs::write(folder.path().join("broken.ply"), "no mesh").expect("written");
        assert!(matches!(library.add_folder(folder.path()), Err(LibraryError::Mesh(_))));
    }
}
