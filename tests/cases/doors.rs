//! Output paths, keys, weights and open ports.
