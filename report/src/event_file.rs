//! Event files as TensorBoard reads them: scalars over the steps of a run.
//!
//! A file is a sequence of records, each a length, a payload and a checksum of either; a payload is a protobuf
//! message of which three fields are needed here.

/// The first record of a file.
///
/// `seconds` is the time of day, since 1970.
pub fn event_file_start(seconds: f64) -> Vec<u8> {
    let mut event = Vec::new();
    fixed64(&mut event, 1, seconds.to_bits());
    bytes(&mut event, 3, b"brain.Event:2");
    record(&event)
}

/// The record of one step's scalars, each with its name.
pub fn scalar_event(seconds: f64, step: u64, scalars: &[(&str, f64)]) -> Vec<u8> {
    let mut summary = Vec::new();
    for (tag, value) in scalars {
        let mut entry = Vec::new();
        bytes(&mut entry, 1, tag.as_bytes());
        key(&mut entry, 2, 5);
        entry.extend_from_slice(&(*value as f32).to_le_bytes());
        bytes(&mut summary, 1, &entry);
    }
    let mut event = Vec::new();
    fixed64(&mut event, 1, seconds.to_bits());
    key(&mut event, 2, 0);
    varint(&mut event, step);
    bytes(&mut event, 5, &summary);
    record(&event)
}

/// A record of the TFRecord format.
fn record(payload: &[u8]) -> Vec<u8> {
    let length = (payload.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), payload, &masked(payload)].concat()
}

/// The checksum, rotated and moved, so that sums over data that holds sums stay good.
fn masked(data: &[u8]) -> [u8; 4] {
    let sum = crc32c::crc32c(data);
    (sum.rotate_right(15).wrapping_add(0xa282_ead8)).to_le_bytes()
}

fn key(to: &mut Vec<u8>, field: u64, wire_type: u64) {
    varint(to, field << 3 | wire_type);
}

fn varint(to: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        to.push(value as u8 | 0x80);
        value >>= 7;
    }
    to.push(value as u8);
}

fn fixed64(to: &mut Vec<u8>, field: u64, value: u64) {
    key(to, field, 1);
    to.extend_from_slice(&value.to_le_bytes());
}

fn bytes(to: &mut Vec<u8>, field: u64, value: &[u8]) {
    key(to, field, 2);
    varint(to, value.len() as u64);
    to.extend_from_slice(value);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_begin_as_those_of_tensorflow_do() {
        let start = event_file_start(1736798723.0);
        // The length of the first payload and its checksum are the same in every event file.
        assert_eq!(start[..12], [0x18, 0, 0, 0, 0, 0, 0, 0, 0xa3, 0x7f, 0x4b, 0x22]);
        assert_eq!(start[12], 9);
        assert_eq!(start[13..21], 1736798723.0_f64.to_le_bytes());
        assert_eq!(start[21..36], *b"\x1a\x0dbrain.Event:2");
        assert_eq!(start[36..], masked(&start[12..36]));
    }

    #[test]
    fn scalars_are_where_the_message_has_them() {
        let event = scalar_event(0.0, 300, &[("loss", 1.5)]);
        let payload = &event[12..event.len() - 4];
        let expected = [
            &[9, 0, 0, 0, 0, 0, 0, 0, 0, 16, 0xac, 2, 42, 13, 10, 11, 10, 4][..],
            b"loss",
            &[21, 0, 0, 0xc0, 0x3f],
        ];
        assert_eq!(payload, expected.concat());
    }
}
