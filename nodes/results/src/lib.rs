//! The node `results`: closes the books of a run and writes the files of its folder, and reads them again.
//!
//! | file | type | content |
//! |---|---|---|
//! | `result.json` | [`RunResult`] | scores, accounting, ages; written last, so it says that the run is complete |
//! | `timing.json` | [`Timing`] | how long things took, and distributions |
//! | `evaluation.json` | [`Samples`] | what the scores are made from |
//!
//! Each message that entered a link to the ego is accounted for:
//! sent = used + skipped + over_limit + distrusted + stale + superseded + lost + rejected + in_flight + unaccounted,
//! where `unaccounted` is 0 unless dora lost something. No term is found by subtracting the others from `sent`.

mod causes;
mod cooperation;
mod distribution;
mod error;
mod files;
mod ledger;
mod links;
mod localization;
mod notes;
mod progress;
mod result;
mod run;
mod sink;
mod timing;

pub use causes::named_counters;
pub use cooperation::{Cooperation, UNUSED, Unused};
pub use distribution::{Ages, Spread};
pub use error::ResultsError;
pub use files::{FilesError, RESULT_FILE, claim, earlier, read_run, retain_parts, run_folder, write_result, write_run};
/// What scores are made of: types of [`RunResult`] and [`Samples`].
pub use realo_scoring as scoring;

pub use ledger::{ChannelKey, Fates, Ledger, Settled};
pub use links::link_books;
pub use progress::RunProgress;
pub use result::{
    Accounted, AgeTable, EdgeBooks, FinalBoxes, Frames, LinkBooks, NodeSummary, RESULT, RunResult, Settings, Transport,
    VERSION,
};
pub use run::{GROUP, GraphStages, Run, SAMPLES, Samples, add_name};
pub use sink::{Results, RunSettings, Settings as ResultsSettings};
pub use timing::{END_TO_END, FRAMEWORK, StageSamples, TIMING, Timing, TimingSamples};
