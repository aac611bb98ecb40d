//! Runs that are ended from outside, and machines that are too small.
