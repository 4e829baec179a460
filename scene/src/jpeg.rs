//! What must be known of a JPEG before it is decoded: its size, its components, whether it is whole.

use std::io::{self, BufRead, Read};

/// The frame header of a JPEG.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Frame {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// 1 for grey, 3 for colour, 4 for CMYK.
    pub components: u8,
}

const START_OF_IMAGE: u8 = 0xd8;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;

/// The first frame header; `None` when this is no JPEG or it ends before one.
pub(crate) fn frame(reader: &mut impl BufRead) -> io::Result<Option<Frame>> {
    match find_frame(reader) {
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
        result => result,
    }
}

fn find_frame(reader: &mut impl BufRead) -> io::Result<Option<Frame>> {
    if read_array(reader)? != [0xff, START_OF_IMAGE] {
        return Ok(None);
    }
    loop {
        let [prefix, mut marker] = read_array(reader)?;
        if prefix != 0xff {
            return Ok(None);
        }
        // Any number of fill bytes may precede a marker.
        while marker == 0xff {
            [marker] = read_array(reader)?;
        }
        if is_alone(marker) {
            continue;
        }
        let length = u16::from_be_bytes(read_array(reader)?);
        // 0xc4, 0xc8 and 0xcc share the range of frames but define tables.
        if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
            let [_precision, h1, h0, w1, w0, components] = read_array(reader)?;
            return Ok(Some(Frame {
                width: u16::from_be_bytes([w1, w0]) as u32,
                height: u16::from_be_bytes([h1, h0]) as u32,
                components,
            }));
        }
        if marker == START_OF_SCAN || marker == END_OF_IMAGE {
            return Ok(None);
        }
        let body = u64::from(length.saturating_sub(2));
        if io::copy(&mut reader.by_ref().take(body), &mut io::sink())? < body {
            return Ok(None);
        }
    }
}

fn read_array<const N: usize>(reader: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    reader.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// Whether a marker has no length and no body.
fn is_alone(marker: u8) -> bool {
    matches!(marker, 0x01 | 0xd0..=0xd8)
}

/// Whether the end-of-image marker follows the last scan. Bytes after it do not matter.
pub(crate) fn is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    loop {
        // In a scan everything up to the next marker is data; elsewhere the marker is right here.
        let Some(prefix) = bytes[at.min(bytes.len())..].iter().position(|b| *b == 0xff) else { return false };
        let Some(&marker) = bytes.get(at + prefix + 1) else { return false };
        at += prefix + 1;
        match marker {
            END_OF_IMAGE => return true,
            // A fill byte: the marker is the next one.
            0xff => {}
            // A stuffed 0xff of the data.
            0x00 => at += 1,
            _ if is_alone(marker) => at += 1,
            _ => {
                let Some(length) = bytes.get(at + 1..at + 3) else { return false };
                at += 1 + u16::from_be_bytes([length[0], length[1]]).max(2) as usize;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A thumbnail with an end of its own in an APP1 segment, then a frame, a scan and the end.
    const WHOLE: &[u8] = b"\xff\xd8\xff\xe1\x00\x06\xff\xd8\xff\xd9\xff\xff\xc2\x00\x0b\x08\x00\x02\x00\x03\x01abc\xff\xda\x00\x03zdata\xff\x00\xff\xd0data\xff\xd9";

    #[test]
    fn the_frame_is_found_behind_other_segments() {
        let found = frame(&mut &*WHOLE).expect("in memory");
        assert_eq!(found, Some(Frame { width: 3, height: 2, components: 1 }));
        assert_eq!(frame(&mut b"\x89PNG".as_slice()).expect("in memory"), None);
        for end in 0..18 {
            assert_eq!(frame(&mut &WHOLE[..end]).expect("in memory"), None);
        }
    }

    #[test]
    fn only_the_image_s_own_end_counts() {
        assert!(is_complete(WHOLE));
        for end in 0..WHOLE.len() {
            assert!(!is_complete(&WHOLE[..end]), "cut at {end}");
        }
        assert!(is_complete(&[WHOLE, b"trailing"].concat()));
    }
}
