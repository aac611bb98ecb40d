//! `#[derive(Settings)]`.

use proc_macro2::{TokenStream, TokenTree};
use quote::quote;
use syn::{Data, DeriveInput, Error, Field, Fields, Ident, Result, Type};

use crate::attribute::{Word, doc, words};

/// One setting of a stage.
struct Setting<'a> {
    name: &'a Ident,
    is_optional: bool,
    about: String,
    default: TokenStream,
    range: Option<(TokenStream, String)>,
    role: Option<TokenStream>,
    is_path: bool,
    /// Whether an empty text is refused.
    is_filled: bool,
    /// Its type, where that has settings of its own, which stand in its place.
    part: Option<&'a Type>,
}

pub fn derive(input: &DeriveInput) -> Result<TokenStream> {
    let fields = match &input.data {
        Data::Struct(data) => match &data.fields {
            Fields::Named(fields) => &fields.named,
            _ => return Err(Error::new_spanned(input, "expected a struct with named fields")),
        },
        _ => return Err(Error::new_spanned(input, "expected a struct")),
    };
    let settings = fields.iter().map(setting).collect::<Result<Vec<_>>>()?;
    let list = list(&settings);
    let checks = settings.iter().filter_map(check);
    let defaults = settings
        .iter()
        .map(|Setting { name, default, .. }| quote!(#name: #default));
    let name = &input.ident;
    Ok(quote! {
        impl ::core::default::Default for #name {
            fn default() -> Self {
                Self { #(#defaults),* }
            }
        }
        impl ::realo_operator::StageSettings for #name {
            const SETTINGS: &'static [::realo_operator::SettingInfo] = #list;
            fn check(&self) -> ::core::result::Result<(), ::realo_operator::config::ConfigError> {
                #(#checks)*
                ::core::result::Result::Ok(())
            }
        }
    })
}

fn setting(field: &Field) -> Result<Setting<'_>> {
    let name = field
        .ident
        .as_ref()
        .ok_or_else(|| Error::new_spanned(field, "expected a name"))?;
    let mut setting = Setting {
        name,
        is_optional: is_named(&field.ty, "Option"),
        about: doc(&field.attrs, name.span(), "a setting")?,
        default: quote!(::core::default::Default::default()),
        range: None,
        role: None,
        is_path: is_named(&field.ty, "PathBuf"),
        is_filled: false,
        part: None,
    };
    let given = words(&field.attrs, "setting")?;
    let has = |word: &str| given.iter().any(|given| given.name == word);
    if has("filled") && has("range") {
        return Err(Error::new(name.span(), "expected `filled` or `range`, found both"));
    }
    if has("flatten") && given.len() > 1 {
        return Err(Error::new(
            name.span(),
            "expected `flatten` alone, found other words beside it",
        ));
    }
    for Word { name, value, .. } in given {
        match name.to_string().as_str() {
            "default" => setting.default = default(value),
            "range" => setting.range = Some((value.clone(), range_words(&name, &value)?)),
            "role" => setting.role = Some(value),
            "path" => setting.is_path = true,
            "filled" => setting.is_filled = true,
            "flatten" => setting.part = Some(&field.ty),
            _ => {
                return Err(Error::new(
                    name.span(),
                    "expected `default`, `range`, `role`, `path`, `filled` or `flatten`",
                ));
            }
        }
    }
    Ok(setting)
}

fn is_named(of: &Type, name: &str) -> bool {
    let Type::Path(path) = of else { return false };
    path.path.segments.last().is_some_and(|last| last.ident == name)
}

/// A text becomes what the field is: a `String`, a path, a name.
fn default(value: TokenStream) -> TokenStream {
    let tokens: Vec<TokenTree> = value.clone().into_iter().collect();
    match &tokens[..] {
        [TokenTree::Literal(literal)] if literal.to_string().starts_with('"') => {
            quote!(::core::convert::Into::into(#literal))
        }
        _ => value,
    }
}

/// What a range says, in words.
fn range_words(at: &Ident, range: &TokenStream) -> Result<String> {
    let text: String = range.to_string().split_whitespace().collect();
    let wrong = || {
        Error::new(
            at.span(),
            "expected a range of numbers, such as `0.0..=1.0`, `1..` or `0.0<..`",
        )
    };
    let (text, is_above) = match text.split_once('<') {
        Some((first, rest)) => (format!("{first}{rest}"), true),
        None => (text, false),
    };
    let (first, last, is_inclusive) = match (text.split_once("..="), text.split_once("..")) {
        (Some((first, last)), _) => (first, last, true),
        (None, Some((first, last))) => (first, last, false),
        (None, None) => return Err(wrong()),
    };
    let number = |text: &str| match text {
        "" => Ok(None),
        text => text.replace('_', "").parse::<f64>().map(Some).map_err(|_| wrong()),
    };
    match (number(first)?, number(last)?) {
        (Some(first), Some(last)) if is_above && is_inclusive => Ok(format!("above {first}, up to {last}")),
        (Some(first), Some(last)) if is_above => Ok(format!("above {first}, below {last}")),
        (Some(first), None) if is_above => Ok(format!("above {first}")),
        _ if is_above => Err(wrong()),
        (Some(first), Some(last)) if is_inclusive => Ok(format!("{first} to {last}")),
        (Some(first), Some(last)) => Ok(format!("{first} to below {last}")),
        (Some(first), None) => Ok(format!("at least {first}")),
        (None, Some(last)) if is_inclusive => Ok(format!("up to {last}")),
        (None, Some(last)) => Ok(format!("below {last}")),
        (None, None) => Err(wrong()),
    }
}

/// The list of settings; where a part has some of its own, they stand in its place.
fn list(settings: &[Setting]) -> TokenStream {
    if settings.iter().all(|setting| setting.part.is_none()) {
        let infos = settings.iter().map(info);
        return quote!(&[#(#infos),*]);
    }
    let parts = settings.iter().map(|setting| match setting.part {
        Some(part) => quote!(<#part as ::realo_operator::StageSettings>::SETTINGS),
        None => {
            let info = info(setting);
            quote!(&[#info])
        }
    });
    quote! {{
        const PARTS: &[&[::realo_operator::SettingInfo]] = &[#(#parts),*];
        &::realo_operator::SettingInfo::joined::<{ ::realo_operator::SettingInfo::count(PARTS) }>(PARTS)
    }}
}

fn info(setting: &Setting) -> TokenStream {
    let Setting {
        name, about, is_path, ..
    } = setting;
    let optional = |value: Option<TokenStream>| match value {
        Some(value) => quote!(::core::option::Option::Some(#value)),
        None => quote!(::core::option::Option::None),
    };
    let words = match (&setting.range, setting.is_filled) {
        (Some((_, words)), _) => Some(words.as_str()),
        (None, true) => Some("not empty"),
        (None, false) => None,
    };
    let range = optional(words.map(|words| quote!(#words)));
    let role = optional(setting.role.clone());
    let name = name.to_string();
    quote! {
        ::realo_operator::SettingInfo { name: #name, about: #about, range: #range, role: #role, is_path: #is_path }
    }
}

/// A range as an expression; Rust has none for `0.0<..`, which leaves out its start.
fn bounds(range: &TokenStream) -> TokenStream {
    let tokens: Vec<TokenTree> = range.clone().into_iter().collect();
    let is = |token: &TokenTree, letter: char| matches!(token, TokenTree::Punct(punct) if punct.as_char() == letter);
    let Some(at) = tokens.iter().position(|token| is(token, '<')) else {
        return range.clone();
    };
    let start: TokenStream = tokens[..at].iter().cloned().collect();
    let is_dot = |token: &TokenTree| is(token, '.');
    let end = tokens[at + 1..].iter().cloned().skip_while(is_dot);
    let is_inclusive = end.clone().next().is_some_and(|token| is(&token, '='));
    let end: TokenStream = end.skip_while(|token| is(token, '=')).collect();
    let end = match (end.is_empty(), is_inclusive) {
        (true, _) => quote!(::core::ops::Bound::Unbounded),
        (false, true) => quote!(::core::ops::Bound::Included(#end)),
        (false, false) => quote!(::core::ops::Bound::Excluded(#end)),
    };
    quote!((::core::ops::Bound::Excluded(#start), #end))
}

fn check(setting: &Setting) -> Option<TokenStream> {
    let name = setting.name;
    if setting.part.is_some() {
        return Some(quote!(::realo_operator::StageSettings::check(&self.#name)?;));
    }
    let key = name.to_string();
    if setting.is_filled {
        return Some(quote! {
            if ::core::convert::AsRef::<::std::ffi::OsStr>::as_ref(&self.#name).is_empty() {
                return ::core::result::Result::Err(::realo_operator::config::ConfigError::range(#key, "a value", &"nothing"));
            }
        });
    }
    let (range, words) = setting.range.as_ref()?;
    let range = bounds(range);
    let test = quote! {
        if !::core::ops::RangeBounds::contains(&(#range), found) {
            return ::core::result::Result::Err(::realo_operator::config::ConfigError::range(#key, #words, found));
        }
    };
    Some(match setting.is_optional {
        true => quote!(if let ::core::option::Option::Some(found) = &self.#name { #test }),
        false => quote!({ let found = &self.#name; #test }),
    })
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
    fn ranges_are_said_in_words() {
        let words = |range| {
            let at = Ident::new("range", proc_macro2::Span::call_site());
            range_words(&at, &range).ok()
        };
        let cases = [
            (quote!(0.0..=1.0), Some("0 to 1")),
            (quote!(0.0..1.0), Some("0 to below 1")),
            (quote!(1..), Some("at least 1")),
            (quote!(..=1.0), Some("up to 1")),
            (quote!(-7..=19), Some("-7 to 19")),
            (quote!(..1_000), Some("below 1000")),
            (quote!(0.0 < ..=1e6), Some("above 0, up to 1000000")),
            (quote!(0 < ..1), Some("above 0, below 1")),
            (quote!(0.0 < ..), Some("above 0")),
            (quote!(<..1), None),
            (quote!(..), None),
            (quote!(MOST), None),
            (quote!(0..MOST), None),
        ];
        for (range, expected) in cases {
            assert_eq!(words(range.clone()).as_deref(), expected, "{range}");
        }
    }

    #[test]
    fn a_setting_without_a_doc_comment_does_not_compile() {
        let error = derived(quote!(
            struct Settings {
                threshold: f64,
            }
        ))
        .unwrap_err();
        assert!(error.contains("needs a doc comment"), "{error}");
        let made = derived(quote!(
            struct Settings {
                #[doc = " IoU."]
                threshold: f64,
            }
        ))
        .unwrap();
        assert!(made.contains("about : \"IoU\""), "{made}");
    }

    #[test]
    fn other_words_than_those_known_are_refused() {
        let error = derived(quote!(
            struct Settings {
                #[doc = "IoU"]
                #[setting(rang = 0..1)]
                threshold: f64,
            }
        ));
        assert!(
            error
                .unwrap_err()
                .contains("expected `default`, `range`, `role`, `path`, `filled` or `flatten`")
        );
        let both = derived(quote!(
            struct Settings {
                #[doc = "Name"]
                #[setting(filled, range = 0..1)]
                name: String,
            }
        ));
        assert!(both.unwrap_err().contains("`filled` or `range`, found both"));
        let beside = derived(quote!(
            struct Settings {
                #[doc = "Part"]
                #[setting(flatten, role = "model")]
                part: Part,
            }
        ));
        assert!(beside.unwrap_err().contains("`flatten` alone"));
        let error = derived(quote!(
            enum Settings {
                One,
            }
        ));
        assert!(error.unwrap_err().contains("expected a struct"));
    }
}
