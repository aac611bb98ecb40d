use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// Takes one of the values that a library has, by its name; help lists the names with what they mean.
///
/// Clap has an enum of its own for this (`ValueEnum`), which libraries without a command line do not know.
pub fn one_of<T>(all: &'static [(T, &'static str, &'static str)]) -> impl TypedValueParser<Value = T>
where
    T: Clone + Send + Sync + 'static,
{
    let values = all.iter().map(|(_, name, about)| match about.is_empty() {
        true => PossibleValue::new(*name),
        false => PossibleValue::new(*name).help(*about),
    });
    PossibleValuesParser::new(values).try_map(|name| {
        let found = all.iter().find(|(_, known, _)| *known == name);
        found
            .map(|(value, ..)| value.clone())
            .ok_or_else(|| format!("unknown name `{name}`"))
    })
}
