//! Values of a log that do not fit their types.
