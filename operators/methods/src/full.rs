//! V2X-Real's networks at full size, built in: the models `full*.toml` that ship.

use crate::arch::Model;

const FULL: &str = include_str!("../../../models/full.toml");

/// Names and files of the models; of each architecture the one that is meant by its name alone comes first.
const FILES: [(&str, &str); 6] = [
    ("full", FULL),
    ("full-late", include_str!("../../../models/full-late.toml")),
    ("full-fcooper", include_str!("../../../models/full-fcooper.toml")),
    ("full-attfuse", include_str!("../../../models/full-attfuse.toml")),
    ("full-v2xvit", include_str!("../../../models/full-v2xvit.toml")),
    ("full-v2vnet", include_str!("../../../models/full-v2vnet.toml")),
];

/// The models, each architecture once, in the order in which it is spoken of.
pub fn models() -> Vec<Model> {
    let mut models: Vec<Model> = Vec::new();
    for model in FILES.iter().map(|(_, text)| parsed(text)) {
        if models.iter().all(|known| known.arch != model.arch) {
            models.push(model);
        }
    }
    models
}

/// The model of a name, if there is one.
pub fn model(name: &str) -> Option<Model> {
    let (_, text) = FILES.iter().find(|(known, _)| *known == name)?;
    Some(parsed(text))
}

/// The model of an architecture, by the name that `arch` has in a model file.
pub fn of_arch(arch: &str) -> Option<Model> {
    models().into_iter().find(|model| model.arch.to_string() == arch)
}

fn parsed(text: &str) -> Model {
    Model::of_texts(text, FULL).expect("a model that ships is sound")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_is_a_model_of_its_name_and_every_architecture_has_one() {
        for (name, _) in FILES {
            assert_eq!(model(name).unwrap().name, name);
        }
        let archs: Vec<String> = models().iter().map(|model| model.arch.to_string()).collect();
        assert_eq!(archs, ["pointpillars", "fcooper", "attfuse", "v2xvit", "v2vnet"]);
        assert_eq!(of_arch("pointpillars").unwrap().name, "full");
        assert!(model("lite").is_none() && of_arch("transformer").is_none());
    }

    #[test]
    fn graphs_can_run_every_one() {
        for model in models() {
            model.check_frame("full.toml".as_ref()).unwrap();
        }
    }
}
