//! Long recordings, many agents, batches of logs.
