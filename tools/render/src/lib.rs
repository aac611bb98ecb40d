//! A frame of a run from above, in the ego's frame: what is there, what was detected, every agent's points, and what
//! only cooperation saw.
//!
//! - [`choose`] finds a frame in the folder of a run, [`choose_all`] the same one in those of several; [`Scene::of`] gathers
//!   what is to be seen of it, from the run's recording and the log that was played.
//! - [`Town`] draws a map of what stands still.
//! - [`Chart`] draws numbers of several runs as curves.
//! - [`draw()`] makes a [`Drawing`] of a scene, and [`write()`] a file of a drawing: shapes ([`svg()`]) or pixels
//!   ([`png()`]), by the file's ending; [`beside`] makes one drawing of several.
//!
//! Letters are outlines of a font that the crate carries, so that a picture is the same on every machine.

mod beside;
mod chart;
pub mod clouds;
mod draw;
mod drawing;
mod error;
mod files;
mod font;
mod fused;
mod judge;
mod labels;
mod legend;
mod marks;
mod pixels;
mod png;
mod run;
mod scene;
mod several;
mod style;
mod svg;
mod thin;
mod town;
mod view;

pub use beside::beside;
pub use chart::{Chart, Curve, Value};
pub use draw::draw;
pub use drawing::{Dots, Drawing, Item, Mark};
pub use error::RenderError;
pub use files::{Format, write};
pub use font::{Fonts, Weight};
pub use judge::{Detected, Judged, There};
pub use png::png;
pub use run::{Chosen, RECORDING, Request, Watch, choose, single_runs};
pub use scene::{Agent, Scene};
pub use several::choose_all;
pub use style::{Fill, Line, Style};
pub use svg::{escaped, svg};
pub use town::Town;
