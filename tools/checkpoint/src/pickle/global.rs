//! Names of Python that may stand in a pickle.

use crate::dtype::Dtype;

/// The names that a checkpoint may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Global {
    /// `collections.OrderedDict`, and `collections.Counter` of a learning-rate schedule.
    Dict,
    /// `torch._utils._rebuild_tensor_v2`.
    Tensor,
    /// `torch._utils._rebuild_parameter`.
    Parameter,
    /// A storage class.
    Storage(Dtype),
    /// A name of what scripts save beside weights. Nothing of it is run, and what it would make is skipped.
    Skipped,
}

/// What makes plain data that stands beside weights: whole modules, and names of others.
const SKIPPED_MODULES: [&str; 13] = [
    "numpy",
    "datetime",
    "pathlib",
    "decimal",
    "fractions",
    "omegaconf",
    "easydict",
    "yacs",
    "addict",
    "munch",
    "pytorch_lightning",
    "lightning",
    "lightning_fabric",
];

const SKIPPED: [(&str, &[&str]); 8] = [
    ("argparse", &["Namespace"]),
    ("types", &["SimpleNamespace"]),
    ("collections", &["defaultdict", "deque"]),
    ("_codecs", &["encode"]),
    ("copyreg", &["_reconstructor"]),
    ("copy_reg", &["_reconstructor"]),
    ("typing", &["Any"]),
    (
        "torch",
        &[
            "Size", "device", "float16", "float32", "float64", "bfloat16", "int8", "uint8", "int32", "int64", "bool",
        ],
    ),
];

const SKIPPED_BUILTINS: [&str; 14] = [
    "set",
    "frozenset",
    "bytearray",
    "complex",
    "slice",
    "range",
    "object",
    "list",
    "dict",
    "tuple",
    "int",
    "float",
    "str",
    "bool",
];

impl Global {
    pub(super) fn named(module: &str, name: &str) -> Option<Global> {
        match (module, name) {
            ("collections", "OrderedDict" | "Counter") => Some(Global::Dict),
            ("torch._utils", "_rebuild_tensor_v2") => Some(Global::Tensor),
            ("torch._utils", "_rebuild_parameter") => Some(Global::Parameter),
            ("torch", class) if Dtype::of_storage(class).is_some() => Dtype::of_storage(class).map(Global::Storage),
            _ => Self::is_skipped(module, name).then_some(Global::Skipped),
        }
    }

    fn is_skipped(module: &str, name: &str) -> bool {
        let top = module.split('.').next().unwrap_or_default();
        match module {
            "builtins" | "__builtin__" => SKIPPED_BUILTINS.contains(&name),
            _ => {
                let named = |(known, names): &(&str, &[&str])| *known == module && names.contains(&name);
                SKIPPED_MODULES.contains(&top) || SKIPPED.iter().any(named)
            }
        }
    }
}
