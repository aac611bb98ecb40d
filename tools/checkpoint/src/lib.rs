//! Checkpoints that PyTorch wrote: what is in them, and models of ours made of them.
//!
//! A checkpoint is a pickle, a program for a small machine, beside the numbers of its tensors. Here it is parsed, never
//! executed: [`pickle`] knows the instructions that `torch.save` writes and the few names that a state dict needs, and
//! refuses everything else by name. [`Checkpoint`] finds the state dict in it and reads a tensor when it is asked for;
//! [`convert`] holds the tensors against a model's list and writes weights and model file.
//!
//! Both formats of `torch.save` are read: the zip archive of PyTorch 1.6 and later, and the one before.

mod checkpoint;
mod convert;
mod dtype;
mod legacy;
mod listing;
mod pickle;
mod source;
mod view;
mod write;

pub use checkpoint::{Checkpoint, ReadError};
pub use convert::{ConvertError, Converted, convert, full_size};
pub use dtype::Dtype;
pub use listing::{ListError, Listing, Row, list};
pub use pickle::PickleError;
pub use view::ViewError;
pub use write::{WriteError, Written, write};

/// Text of a file as a line of ours: no control characters, and not without end.
fn shown(text: &str) -> String {
    let mut shown: String = text.chars().take(LONGEST).collect::<String>().escape_debug().collect();
    if text.chars().nth(LONGEST).is_some() {
        shown.push('…');
    }
    shown
}

/// Characters of a text that are shown.
const LONGEST: usize = 120;
