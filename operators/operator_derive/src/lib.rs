//! Derives of `realo-operator`: a stage says its settings and ports once, as documented types.
//!
//! Doc comments become the help of `realo operators` and the reference page, so each field and variant needs one.

mod attribute;
mod ports;
mod settings;
mod stage;

use proc_macro::TokenStream;
use syn::{DeriveInput, parse_macro_input};

/// Makes the settings of a stage from a struct: `Default`, the list of settings, and the check of ranges.
///
/// A field may say `#[setting(default = …, range = …, role = "…")]`, or `#[setting(flatten)]` beside `#[serde(flatten)]`: then its
/// own settings stand in its place. A default that is not given is the type's own. A range is
/// one of Rust's with numbers as bounds, or `0.0<..=1.0`, which leaves out its start; `None` is always inside. A role is a word that tools look for.
/// A `PathBuf` is a path; of a text that may name a file `path` says so. A text or path
/// that is `filled` is not empty.
#[proc_macro_derive(Settings, attributes(setting))]
pub fn settings(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    settings::derive(&input)
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}

/// Makes the inputs of a stage from an enum, in priority order.
///
/// A variant is a port: `Name(Header, Payload)`, or `Name(Message)` with `#[port(any_of(Type, …))]`. Its name in graphs is the
/// variant's in `snake_case`. `#[port(…)]` lists properties, which are the methods of `Port`: `latest`, `joined("set")`, `of(Ego)`.
#[proc_macro_derive(Inputs, attributes(port))]
pub fn inputs(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    ports::inputs(&input)
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}

/// Makes the outputs of a stage from an enum, as [`macro@Inputs`] does its inputs.
#[proc_macro_derive(Outputs, attributes(port))]
pub fn outputs(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    ports::outputs(&input)
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}

/// Describes a stage by its struct: the name is the struct's in `kebab-case`, the line of `realo operators` the first paragraph of
/// its doc comment, and its types are those that are called `Settings`, `Input` and `Output` where it is declared.
///
/// `#[stage(…)]` may say `name = "…"`, `settings = …`, `input = …`, `output = …`, `counters(…, …)` or `counters = LIST`, and
/// `examine = FUNCTION`.
#[proc_macro_derive(Describe, attributes(stage))]
pub fn describe(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    stage::derive(&input)
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}
