//! What the attributes of a field or variant say.

use proc_macro2::{Delimiter, Ident, Span, TokenStream, TokenTree};
use syn::{Attribute, Error, Expr, ExprLit, Lit, Meta, Result};

/// One word of an attribute: `latest`, `of(Ego)` or `default = 0.15`.
pub struct Word {
    /// The word.
    pub name: Ident,
    /// What stands in parentheses, or behind `=`.
    pub value: TokenStream,
    /// Whether it stands in parentheses.
    pub is_list: bool,
}

/// The words of all attributes of a name.
pub fn words(attributes: &[Attribute], name: &str) -> Result<Vec<Word>> {
    let mut words = Vec::new();
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident(name)) {
        let mut open = Vec::new();
        for token in attribute.meta.require_list()?.tokens.clone() {
            match &token {
                TokenTree::Punct(punct) if punct.as_char() == ',' => words.extend(word(std::mem::take(&mut open))?),
                _ => open.push(token),
            }
        }
        words.extend(word(open)?);
    }
    Ok(words)
}

fn word(tokens: Vec<TokenTree>) -> Result<Option<Word>> {
    let mut tokens = tokens.into_iter();
    let Some(first) = tokens.next() else { return Ok(None) };
    let TokenTree::Ident(name) = first else {
        return Err(Error::new(
            first.span(),
            "expected a word such as `latest` or `default = 1`",
        ));
    };
    let (value, is_list) = match tokens.next() {
        None => (TokenStream::new(), false),
        Some(TokenTree::Punct(punct)) if punct.as_char() == '=' => (tokens.collect(), false),
        Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Parenthesis => (group.stream(), true),
        Some(other) => return Err(Error::new(other.span(), "expected `= …` or `(…)`")),
    };
    Ok(Some(Word { name, value, is_list }))
}

/// The first paragraph of the doc comment as one line, without the full stop at its end.
pub fn doc(attributes: &[Attribute], span: Span, what: &str) -> Result<String> {
    let mut lines = Vec::new();
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("doc")) {
        if let Meta::NameValue(value) = &attribute.meta
            && let Expr::Lit(ExprLit {
                lit: Lit::Str(text), ..
            }) = &value.value
        {
            lines.extend(text.value().split('\n').map(|line| line.trim().to_string()));
        }
    }
    let paragraph = lines
        .into_iter()
        .skip_while(String::is_empty)
        .take_while(|line| !line.is_empty());
    let text = paragraph.collect::<Vec<_>>().join(" ");
    let text = text.trim_end_matches('.');
    if text.is_empty() {
        return Err(Error::new(
            span,
            format!("{what} needs a doc comment: it is shown by `realo operators` and the reference page"),
        ));
    }
    Ok(text.to_string())
}
