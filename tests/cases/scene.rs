//! A small scene whose answer is known, and logs that differ from it.
