//! What a model's `arch` may be, and the list of methods.

mod any;
mod choice;
mod list;

pub use any::AnyMethod;
pub use choice::{Arch, Model};
pub use list::{Entry, METHODS, add, methods};
