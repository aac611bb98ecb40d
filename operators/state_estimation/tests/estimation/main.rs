//! The estimators on made drives: errors, consistency, replay, bad input, roadside units.

mod bad_input;
mod drives;
mod hold;
mod misled;
mod replay;
mod world;
