//! Derives of `realo-operator`: a stage says its settings and ports once, as documented types.
//!
//! Doc comments become the help of `realo operators` and the reference page, so each field and variant needs one.

mod attribute;
mod ports;
mod settings;

use proc_macro::TokenStream;
use syn::{DeriveInput, parse_macro_input};

/// Makes the settings of a stage from a struct: `Default`, the list of arguments, and the check of ranges.
///
/// A field may say `#[setting(default = …, range = …, role = "…")]`. A default that is not given is the type's own. A range is
/// one of Rust's with numbers as bounds; `None` is always inside. A role is a word that tools look for.
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
