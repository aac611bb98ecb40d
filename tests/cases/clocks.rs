//! Agents whose stamps and poses do not fit together.
