//! What a file is to its graph.

use std::fmt;

use serde::{Deserialize, Serialize};

/// What a file is to its graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// From points to a BEV map.
    #[default]
    Encoder,
    /// From maps of several agents to one.
    Fusion,
    /// From a map to boxes.
    Head,
    /// From points to boxes.
    Detector,
}

impl Role {
    /// All of them.
    pub const ALL: [Role; 4] = [Role::Encoder, Role::Fusion, Role::Head, Role::Detector];

    /// The role that the settings of a program name.
    ///
    /// # Errors
    /// No role, or none of these.
    pub fn of_args(args: impl Iterator<Item = String>) -> Result<Role, String> {
        let known = Role::ALL.map(|role| format!("role={role}")).join(", ");
        let named = args
            .into_iter()
            .find_map(|arg| arg.strip_prefix("role=").map(str::to_string));
        let named =
            named.ok_or_else(|| format!("expected what the file is to the graph, one of {known}; found no `role`"))?;
        let role = Role::ALL.into_iter().find(|role| role.to_string() == named);
        role.ok_or_else(|| format!("expected one of {known}, found `role={named}`"))
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Role::Encoder => "encoder",
            Role::Fusion => "fusion",
            Role::Head => "head",
            Role::Detector => "detector",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_role_is_named_or_the_known_ones_are_listed() {
        let of = |args: &[&str]| Role::of_args(args.iter().map(|arg| arg.to_string()));
        assert_eq!(of(&["model=a.onnx", "role=head"]), Ok(Role::Head));
        for args in [&["model=a.onnx"][..], &["role=heads"]] {
            let error = of(args).unwrap_err();
            assert!(
                error.contains("role=encoder, role=fusion, role=head, role=detector"),
                "{error}"
            );
        }
    }
}
