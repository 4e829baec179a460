//! The weights that come with the program.

use super::Weights;

/// The safetensors file of the default weights; what trained them stands beside it.
const DEFAULT_FILE: &[u8] = include_bytes!("../../weights/default.safetensors");

impl Weights {
    /// The file of the default weights.
    pub fn default_file() -> &'static [u8] {
        DEFAULT_FILE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_weights_are_whole_and_free() {
        let weights = Weights::from_bytes(DEFAULT_FILE).expect("weights of this network");
        assert_eq!(weights.to_bytes(), DEFAULT_FILE, "the file is as this program writes it");
        assert!(weights.metadata().licence.contains("MIT"), "{}", weights.metadata().licence);
        assert!(weights.metadata().spacing_px.is_some_and(|px| px > 0.0));
    }
}
