//! The size of the working image.

/// The image's size scaled so that its longest side is at most `max_size`; never enlarged, and never
/// below one pixel. The network pads to multiples of 32 itself and crops back.
pub fn working_size(width: u32, height: u32, max_size: Option<u32>) -> (u32, u32) {
    let longest = width.max(height);
    match max_size {
        Some(max) if max < longest => {
            let scaled =
                |side: u32| ((side as u64 * max as u64 + longest as u64 / 2) / longest as u64).max(1) as u32;
            (scaled(width), scaled(height))
        }
        _ => (width, height),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_side_is_limited_and_the_aspect_kept() {
        assert_eq!(working_size(2832, 2128, Some(1152)), (1152, 866));
        assert_eq!(working_size(2128, 2832, Some(1152)), (866, 1152));
        assert_eq!(working_size(640, 480, Some(1152)), (640, 480));
        assert_eq!(working_size(640, 480, None), (640, 480));
        assert_eq!(working_size(10_000, 1, Some(100)), (100, 1));
    }
}
