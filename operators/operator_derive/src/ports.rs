//! `#[derive(Inputs)]` and `#[derive(Outputs)]`.

use proc_macro2::TokenStream;
use quote::{format_ident, quote};
use syn::{Data, DeriveInput, Error, Fields, Ident, Result, Type, Variant};

use crate::attribute::{Word, doc, words};

/// One port of a stage.
struct PortOf<'a> {
    variant: &'a Ident,
    name: String,
    about: String,
    /// Its payload; `None` where the variant carries whole messages.
    payload: Option<&'a Type>,
    /// An expression of the types that it carries.
    types: TokenStream,
    /// Calls that give it its properties.
    properties: TokenStream,
}

pub fn inputs(input: &DeriveInput) -> Result<TokenStream> {
    let ports = ports(input)?;
    let arms = ports
        .iter()
        .enumerate()
        .map(|(index, PortOf { variant, payload, .. })| match payload {
            Some(payload) => quote! {
                #index => {
                    let (header, payload) = <#payload as ::realo_operator::PortPayload>::of_message(message)?;
                    ::core::result::Result::Ok(Self::#variant(header, payload))
                }
            },
            None => quote!(#index => ::core::result::Result::Ok(Self::#variant(message)),),
        });
    let (constants, list) = (constants(input, &ports), list(&ports));
    let name = &input.ident;
    let (generics, of, bounds) = input.generics.split_for_impl();
    Ok(quote! {
        #constants
        impl #generics ::realo_operator::StageInputs for #name #of #bounds {
            const PORTS: &'static [::realo_operator::Port] = #list;
            fn read(
                port: ::realo_operator::PortId,
                message: ::realo_operator::Message,
            ) -> ::core::result::Result<Self, ::realo_operator::PortError> {
                match port.0 {
                    #(#arms)*
                    _ => ::core::result::Result::Err(::realo_operator::PortError::unknown(Self::PORTS, port)),
                }
            }
        }
    })
}

pub fn outputs(input: &DeriveInput) -> Result<TokenStream> {
    let ports = ports(input)?;
    let arms = ports
        .iter()
        .enumerate()
        .map(|(index, PortOf { variant, payload, .. })| match payload {
            Some(_) => quote! {
                Self::#variant(header, payload) => (
                    ::realo_operator::PortId(#index),
                    ::realo_operator::Message::new(header, payload),
                ),
            },
            None => quote!(Self::#variant(message) => (::realo_operator::PortId(#index), message),),
        });
    let (constants, list) = (constants(input, &ports), list(&ports));
    let name = &input.ident;
    let (generics, of, bounds) = input.generics.split_for_impl();
    Ok(quote! {
        #constants
        impl #generics ::realo_operator::StageOutputs for #name #of #bounds {
            const PORTS: &'static [::realo_operator::Port] = #list;
            fn into_message(self) -> (::realo_operator::PortId, ::realo_operator::Message) {
                match self {
                    #(#arms)*
                }
            }
        }
    })
}

/// The places of ports by their names, for drivers, sources and tests.
fn constants(input: &DeriveInput, ports: &[PortOf]) -> TokenStream {
    let constants = ports.iter().enumerate().map(|(index, port)| {
        let constant = format_ident!("{}", port.name.to_uppercase(), span = port.variant.span());
        let about = format!("The port `{}`.", port.name);
        quote! {
            #[doc = #about]
            #[allow(dead_code)]
            pub const #constant: ::realo_operator::PortId = ::realo_operator::PortId(#index);
        }
    });
    let name = &input.ident;
    let (generics, of, bounds) = input.generics.split_for_impl();
    quote!(impl #generics #name #of #bounds { #(#constants)* })
}

fn list(ports: &[PortOf]) -> TokenStream {
    let ports = ports.iter().map(|port| {
        let PortOf {
            name,
            about,
            types,
            properties,
            ..
        } = port;
        quote!(::realo_operator::Port::new(#name, #types, #about) #properties)
    });
    quote!(&[#(#ports),*])
}

fn ports(input: &DeriveInput) -> Result<Vec<PortOf<'_>>> {
    match &input.data {
        Data::Enum(data) => data.variants.iter().map(port).collect(),
        _ => Err(Error::new_spanned(input, "expected an enum, a variant for each port")),
    }
}

fn port(variant: &Variant) -> Result<PortOf<'_>> {
    let about = doc(&variant.attrs, variant.ident.span(), "a port")?;
    let mut any_of = None;
    let mut properties = TokenStream::new();
    for Word { name, value, .. } in words(&variant.attrs, "port")? {
        match name.to_string().as_str() {
            "any_of" => any_of = Some(any_of_types(&name, value)?),
            "of" => properties.extend(quote!(.of(::realo_operator::Side::#value))),
            _ => properties.extend(quote!(.#name(#value))),
        }
    }
    let types: Vec<&Type> = match &variant.fields {
        Fields::Unnamed(fields) => fields.unnamed.iter().map(|field| &field.ty).collect(),
        _ => Vec::new(),
    };
    let (payload, types) = match (&types[..], any_of) {
        ([_, payload], None) => (
            Some(*payload),
            quote!(<#payload as ::realo_operator::PortPayload>::TYPES),
        ),
        ([_], Some(types)) => (None, types),
        _ => {
            let expected = "expected `(Header, Payload)`, or `(Message)` with `#[port(any_of(…))]`";
            return Err(Error::new_spanned(variant, expected));
        }
    };
    Ok(PortOf {
        name: snake(&variant.ident),
        variant: &variant.ident,
        about,
        payload,
        types,
        properties,
    })
}

fn any_of_types(at: &Ident, value: TokenStream) -> Result<TokenStream> {
    let mut types = Vec::new();
    for token in value {
        match token {
            proc_macro2::TokenTree::Ident(name) => types.push(quote!(::realo_operator::PayloadType::#name)),
            proc_macro2::TokenTree::Punct(_) => {}
            other => return Err(Error::new(other.span(), "expected names of payloads")),
        }
    }
    match types.is_empty() {
        true => Err(Error::new(at.span(), "expected names of payloads")),
        false => Ok(quote!(&[#(#types),*])),
    }
}

fn snake(name: &Ident) -> String {
    let mut text = String::new();
    for (index, letter) in name.to_string().chars().enumerate() {
        if letter.is_uppercase() && index > 0 {
            text.push('_');
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
        inputs(&input)
            .map(|made| made.to_string())
            .map_err(|error| error.to_string())
    }

    #[test]
    fn a_port_has_its_variants_name_and_the_properties_that_it_says() {
        let made = derived(quote! {
            enum Input {
                #[doc = " Sweeps."]
                #[port(latest, of(Ego), joined("set"))]
                EgoClouds(Header, PointCloud),
            }
        })
        .unwrap();
        assert!(made.contains("\"ego_clouds\"") && made.contains("EGO_CLOUDS"), "{made}");
        let chain = ". latest () . of (:: realo_operator :: Side :: Ego) . joined (\"set\")";
        assert!(made.contains(chain), "{made}");
    }

    #[test]
    fn what_is_no_port_does_not_compile() {
        let cases = [
            (
                quote!(
                    enum Input {
                        Clouds(Header, PointCloud),
                    }
                ),
                "needs a doc comment",
            ),
            (
                quote!(
                    enum Input {
                        #[doc = "a"]
                        Clouds,
                    }
                ),
                "expected `(Header, Payload)`",
            ),
            (
                quote!(
                    enum Input {
                        #[doc = "a"]
                        Clouds(Message),
                    }
                ),
                "expected `(Header, Payload)`",
            ),
            (
                quote!(
                    enum Input {
                        #[doc = "a"]
                        #[port(any_of())]
                        Clouds(Message),
                    }
                ),
                "names of payloads",
            ),
            (
                quote!(
                    struct Input {
                        clouds: PointCloud,
                    }
                ),
                "expected an enum",
            ),
        ];
        for (input, expected) in cases {
            let error = derived(input.clone()).unwrap_err();
            assert!(error.contains(expected), "{input}: {error}");
        }
    }
}
