//! Writers, importers and converters.
