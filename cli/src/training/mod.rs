//! What surrounds a training run: its samples, its curves, the wish to stop it.

mod curves;
mod samples;
mod scenes;
mod stop;

pub use self::curves::Curves;
pub use self::samples::Samples;
pub use self::scenes::add_scene;
pub use self::stop::Stop;
