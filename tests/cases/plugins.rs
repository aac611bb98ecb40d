//! Stages of one's own, and settings in a word.
