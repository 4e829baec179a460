//! Little-endian binary files, streamed front to back: a model may be larger than the memory.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use super::ReadError;

/// The longest text that a binary file may hold; names are shorter.
const LONGEST_TEXT: usize = 1 << 16;

/// The bytes of a file not read yet; every error knows where it happened.
pub(super) struct Bytes {
    path: PathBuf,
    reader: BufReader<File>,
    length: u64,
    at: u64,
}

impl Bytes {
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let io_error = |source| ReadError::Io { path: path.to_owned(), source };
        let file = File::open(path).map_err(io_error)?;
        let length = file.metadata().map_err(io_error)?.len();
        let reader = BufReader::with_capacity(1 << 18, file);
        Ok(Self { path: path.to_owned(), reader, length, at: 0 })
    }

    /// An error at the current position.
    pub fn error(&self, what: impl Into<String>) -> ReadError {
        self.error_at(self.at, what)
    }

    /// An error somewhere before.
    pub fn error_at(&self, offset: u64, what: impl Into<String>) -> ReadError {
        ReadError::Binary { path: self.path.clone(), offset, what: what.into() }
    }

    /// Where reading goes on.
    pub fn at(&self) -> u64 {
        self.at
    }

    fn left(&self) -> u64 {
        self.length - self.at
    }

    fn take(&mut self, length: u64) -> Result<(), ReadError> {
        if length > self.left() {
            let left = self.left();
            return Err(self.error(format!("the file is truncated: {length} bytes needed, {left} left")));
        }
        self.at += length;
        Ok(())
    }

    fn io_error(&self, source: std::io::Error) -> ReadError {
        ReadError::Io { path: self.path.clone(), source }
    }

    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], ReadError> {
        self.take(N as u64)?;
        let mut array = [0; N];
        self.reader.read_exact(&mut array).map_err(|source| self.io_error(source))?;
        Ok(array)
    }

    pub fn skip(&mut self, length: u64) -> Result<(), ReadError> {
        self.take(length)?;
        let offset = i64::try_from(length).expect("a file is shorter than 2^63 bytes");
        self.reader.seek_relative(offset).map_err(|source| self.io_error(source))
    }

    pub fn u32(&mut self) -> Result<u32, ReadError> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn f32(&mut self) -> Result<f32, ReadError> {
        self.array().map(f32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Result<u64, ReadError> {
        self.array().map(u64::from_le_bytes)
    }

    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array()?);
        }
        Ok(values)
    }

    /// A number of records, each of `least` bytes or more, that the rest of the file can hold.
    pub fn count(&mut self, least: u64, of: &str) -> Result<usize, ReadError> {
        let start = self.at;
        let count = self.u64()?;
        let room = self.left() / least;
        if count > room {
            let what = format!("{count} {of} are announced, the rest of the file holds {room}");
            return Err(self.error_at(start, what));
        }
        Ok(count as usize)
    }

    /// A text that ends with NUL.
    pub fn text_to_nul(&mut self) -> Result<String, ReadError> {
        let mut text = Vec::new();
        let limit = LONGEST_TEXT as u64;
        (&mut self.reader).take(limit).read_until(0, &mut text).map_err(|source| self.io_error(source))?;
        if text.pop() != Some(0) {
            return Err(self.error("an image name has no end"));
        }
        let text = String::from_utf8(text).map_err(|_| self.error("an image name is not UTF-8"))?;
        self.at += text.len() as u64 + 1;
        Ok(text)
    }

    /// A text after its length.
    pub fn text_of_length(&mut self) -> Result<String, ReadError> {
        let start = self.at;
        let length = self.count(1, "characters")?;
        if length > LONGEST_TEXT {
            return Err(self.error_at(start, format!("a name of {length} bytes is too long")));
        }
        let mut text = vec![0; length];
        self.take(length as u64)?;
        self.reader.read_exact(&mut text).map_err(|source| self.io_error(source))?;
        String::from_utf8(text).map_err(|_| self.error_at(start, "a name is not UTF-8"))
    }

    /// Refuses bytes after the last record.
    pub fn finish(self) -> Result<(), ReadError> {
        match self.left() {
            0 => Ok(()),
            left => Err(self.error(format!("{left} bytes follow the last record"))),
        }
    }
}
