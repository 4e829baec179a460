//! The weights that come with the program.

use super::Weights;

/// The safetensors file of the default weights. It stands in `mvsnet/weights/default.safetensors` with the
/// configuration that trained it beside it; this is the line that embeds it.
const DEFAULT_FILE: Option<&[u8]> = None;

impl Weights {
    /// The file of the default weights; `None` in a program that was built without any.
    pub fn default_file() -> Option<&'static [u8]> {
        DEFAULT_FILE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_weights_are_whole_and_free() {
        let Some(file) = Weights::default_file() else {
            eprintln!("SKIPPED default_weights_are_whole_and_free: no default weights are embedded");
            return;
        };
        let weights = Weights::from_bytes(file).expect("weights of this network");
        assert_eq!(weights.to_bytes(), file, "the file is as this program writes it");
        assert!(weights.metadata().licence.contains("MIT"), "{}", weights.metadata().licence);
        assert!(weights.metadata().spacing_px.is_some_and(|px| px > 0.0));
    }
}
