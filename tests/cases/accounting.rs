//! What is dropped is said in the notes.
