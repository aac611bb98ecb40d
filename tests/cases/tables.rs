//! What tables say.
