//! Writes logs in the layouts of data sets, for the tools of others.
//!
//! [`KINDS`] has the layouts, each behind the trait [`Exporter`]. [`export`] writes a log in one of them: a folder that appears when
//! it is complete. What a layout cannot hold is reported with it. `realo-importer` reads each of them back. [`export_rrd`] makes a run or
//! a log a recording of rerun, which is not read back.

mod error;
mod exported;
mod folder;
mod kinds;
mod lost;
mod options;
mod places;
mod rrd;
mod scene;

pub use error::ExportError;
pub use exported::{Exported, ExportedAgent};
pub use folder::{Folder, MANIFEST, check};
pub use kinds::{Exporter, KINDS, Kind, Report, export, export_recording, exporter, list};
pub use options::{BoxSource, LabelSource, OPTIONS, OptionInfo, Options, option_info};
pub use rrd::{RrdCounts, RrdRequest, export_rrd};
