//! Agents on their way through the transformer.

/// An agent on its way through the transformer.
#[derive(Default)]
pub struct State {
    pub kind: usize,
    /// `[rows, columns, channels]`.
    pub map: Vec<f32>,
    /// `[rows, columns]`: whether the agent can be asked there.
    pub covered: Vec<bool>,
}

/// What must be known of an agent to ask it.
#[derive(Clone, Copy)]
pub struct Asked<'a> {
    pub kind: usize,
    /// By cell of a tile.
    pub covered: &'a [bool],
}
