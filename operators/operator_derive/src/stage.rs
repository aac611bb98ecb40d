//! `#[derive(Describe)]`.

use proc_macro2::TokenStream;
use quote::quote;
use syn::{Data, DeriveInput, Error, Ident, Result};

use crate::attribute::{Word, doc, words};

pub fn derive(input: &DeriveInput) -> Result<TokenStream> {
    if !matches!(input.data, Data::Struct(_)) {
        return Err(Error::new_spanned(input, "expected the struct of a stage"));
    }
    let stage = &input.ident;
    let about = doc(&input.attrs, stage.span(), "a stage")?;
    let kebab = kebab(stage);
    let mut name = quote!(#kebab);
    let (mut settings, mut inputs, mut outputs) = (quote!(Settings), quote!(Input), quote!(Output));
    let (mut counters, mut examine, mut maps) = (TokenStream::new(), TokenStream::new(), TokenStream::new());
    for word in words(&input.attrs, "stage")? {
        let Word {
            name: key,
            value,
            is_list,
        } = word;
        if value.is_empty() {
            return Err(Error::new(key.span(), "expected a value"));
        }
        match key.to_string().as_str() {
            "name" => name = value,
            "settings" => settings = value,
            "input" => inputs = value,
            "output" => outputs = value,
            "counters" => {
                let list = if is_list { quote!(&[#value]) } else { value };
                counters = quote!(const COUNTERS: &'static [::realo_operator::Counter] = #list;);
            }
            "examine" => {
                examine = quote! {
                    fn examine(settings: &Self::Settings) -> ::core::result::Result<(), ::realo_operator::Error> {
                        #value(settings).map_err(::core::convert::Into::into)
                    }
                };
            }
            "maps" => {
                maps = quote! {
                    fn maps(settings: &Self::Settings) -> ::std::vec::Vec<(&'static str, ::realo_operator::KnownMap)> {
                        #value(settings)
                    }
                };
            }
            _ => {
                let expected = "expected `name`, `settings`, `input`, `output`, `counters`, `examine` or `maps`";
                return Err(Error::new(key.span(), expected));
            }
        }
    }
    let (generics, of, bounds) = input.generics.split_for_impl();
    Ok(quote! {
        impl #generics ::realo_operator::Describe for #stage #of #bounds {
            type Settings = #settings;
            type Input = #inputs;
            type Output = #outputs;
            const NAME: &'static str = #name;
            const ABOUT: &'static str = #about;
            #counters
            #examine
            #maps
        }
    })
}

/// `FusionBoxes` as graphs name it: `fusion-boxes`.
fn kebab(name: &Ident) -> String {
    let mut text = String::new();
    for (index, letter) in name.to_string().chars().enumerate() {
        if letter.is_uppercase() && index > 0 {
            text.push('-');
        }
        text.extend(letter.to_lowercase());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn derived(input: TokenStream) -> std::result::Result<String, String> {
        let input: DeriveInput = syn::parse2(input).map_err(|error| error.to_string())?;
        derive(&input)
            .map(|made| made.to_string())
            .map_err(|error| error.to_string())
    }

    #[test]
    fn a_stage_is_as_its_struct_says() {
        let made = derived(quote! {
            #[doc = " Fuses boxes,"]
            #[doc = " all of them."]
            #[doc = ""]
            #[doc = " More."]
            #[stage(input = Input<Boxes>, counters(ONE, other::TWO), examine = check, maps = sizes)]
            struct FusionBoxes {
                a: u8,
            }
        })
        .unwrap();
        for part in [
            "NAME : & \'static str = \"fusion-boxes\"",
            "ABOUT : & \'static str = \"Fuses boxes, all of them\"",
            "type Settings = Settings ; type Input = Input < Boxes > ; type Output = Output ;",
            "= & [ONE , other :: TWO] ;",
            "check (settings)",
            "sizes (settings)",
        ] {
            assert!(made.contains(part), "{part}: {made}");
        }
        let made = derived(quote! {
            #[doc = "a"]
            #[stage(name = "other", counters = ALL)]
            struct One;
        })
        .unwrap();
        assert!(made.contains("= \"other\"") && made.contains("= ALL ;"), "{made}");
    }

    #[test]
    fn refuses_what_is_not_a_stage() {
        let cases = [
            (
                quote!(
                    struct One;
                ),
                "needs a doc comment",
            ),
            (
                quote!(
                    #[doc = "a"]
                    #[stage(counter = ALL)]
                    struct One;
                ),
                "expected `name`, `settings`",
            ),
            (
                quote!(
                    #[doc = "a"]
                    #[stage(counters)]
                    struct One;
                ),
                "expected a value",
            ),
            (
                quote!(
                    #[doc = "a"]
                    enum One {}
                ),
                "expected the struct",
            ),
        ];
        for (input, expected) in cases {
            let error = derived(input.clone()).unwrap_err();
            assert!(error.contains(expected), "{input}: {error}");
        }
    }
}
