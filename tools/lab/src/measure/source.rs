//! The results that rows name, as JSON.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail, eyre};
use serde_json::{Value, json};

use super::json::find;
use super::plan::{Plan, captures};

/// What a row's result is called that is a figure of the paper.
const PAPER: &str = "paper";
/// The kind of what agents say of where they are: everybody sends it, whatever the strategy.
const STATE: &str = "agent_state";

/// The results of the steps of a page, and the paper's figures.
pub struct Results<'a> {
    plan: &'a Plan,
    root: &'a Path,
    paper: &'a Value,
}

/// A result of a step.
fn read(path: &Path) -> Result<Value> {
    let failed = || {
        format!(
            "{}: expected the result of a step (--fresh measures it anew)",
            path.display()
        )
    };
    let text = fs::read_to_string(path).wrap_err_with(failed)?;
    serde_json::from_str(&text).wrap_err_with(failed)
}

impl<'a> Results<'a> {
    /// The results of a plan that has run.
    pub fn new(plan: &'a Plan, root: &'a Path, paper: &'a Value) -> Self {
        Results { plan, root, paper }
    }

    /// A result: `STEP` is what the step printed or its run, `STEP/GRAPH` one of its runs, `paper` the figures of the paper.
    /// `STEP:PATH` and `paper:PATH` are a part of it.
    ///
    /// # Errors
    /// A step that is not there or has several commands, a file that cannot be read, and a path that leads nowhere.
    pub fn find(&self, name: &str) -> Result<Value> {
        let (of, path) = name.split_once(':').unwrap_or((name, ""));
        let path = if path.is_empty() {
            String::new()
        } else {
            format!("/{path}")
        };
        match of {
            PAPER => find(self.paper, &path).cloned(),
            _ => find(&self.whole(of)?, &path).cloned(),
        }
    }

    /// The curves of a sweep over a setting, as a table in Markdown.
    ///
    /// # Errors
    /// As [`Results::drawing`]; a file that cannot be read.
    pub fn curves(&self, step: &str, setting: &str) -> Result<String> {
        let file = self.drawing(step, setting)?.with_extension("md");
        fs::read_to_string(&file).wrap_err_with(|| {
            let found = file.display();
            format!("{found}: expected what a sweep over `{setting}` wrote (--fresh measures it anew)")
        })
    }

    /// The file in which they are drawn.
    ///
    /// # Errors
    /// A step that is not there.
    pub fn drawing(&self, step: &str, setting: &str) -> Result<PathBuf> {
        let job = self.plan.jobs.iter().find(|job| job.step == step);
        let job = job.ok_or_else(|| eyre!("there is no step `{step}`"))?;
        Ok(self.root.join(&job.output).join(format!("{setting}.svg")))
    }

    fn whole(&self, name: &str) -> Result<Value> {
        let (step, graph) = name.split_once('/').unwrap_or((name, ""));
        let mut jobs = self.plan.jobs.iter().filter(|job| job.step == step);
        let (job, others) = (jobs.next(), jobs.count());
        let job = job.ok_or_else(|| eyre!("there is no step `{step}`"))?;
        if others > 0 {
            bail!("step `{step}` has several commands, so it has no result of its own");
        }
        if captures(job) {
            return read(&self.plan.printed(job, self.root));
        }
        let folder = self.root.join(&job.output).join(graph);
        let mut result = read(&folder.join("result.json"))?;
        result["timing"] = read(&folder.join("timing.json"))?;
        result["derived"] = derived(&result);
        Ok(result)
    }

    /// The instructions that the networks of some results were computed with.
    ///
    /// # Errors
    /// As [`Results::find`].
    pub fn instructions(&self, names: impl Iterator<Item = String>) -> Result<Vec<String>> {
        let mut found = BTreeMap::new();
        for name in names {
            if let Some(isa) = self.find(&name)?.get("isa").and_then(Value::as_str) {
                found.insert(isa.to_string(), ());
            }
        }
        Ok(found.into_keys().filter(|isa| !isa.is_empty()).collect())
    }
}

/// Values that a run's files have only in parts.
pub fn derived(result: &Value) -> Value {
    json!({ "kb_per_frame": kilobytes_per_frame(result) })
}

/// KB that crossed the links to the ego for each of its sweeps, without states of agents.
fn kilobytes_per_frame(result: &Value) -> Option<f64> {
    let links = result.get("links")?.as_object()?;
    let kinds = links.values().filter_map(Value::as_object).flatten();
    let books = kinds.filter(|(kind, _)| *kind != STATE).map(|(_, books)| books);
    let bytes: u64 = books.filter_map(|books| books.get("bytes")?.as_u64()).sum();
    let frames = result["frames"]["total"].as_f64().filter(|total| *total > 0.0)?;
    Some(bytes as f64 / 1000.0 / frames)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_are_not_part_of_what_crossed() {
        let result = json!({
            "frames": { "total": 10 },
            "links": { "a-b": { "boxes": { "bytes": 20000 }, "agent_state": { "bytes": 5 } }, "c-b": { "boxes": { "bytes": 1000 } } },
        });
        assert_eq!(derived(&result), json!({ "kb_per_frame": 2.1 }));
        assert_eq!(
            derived(&json!({ "frames": { "total": 0 }, "links": {} })),
            json!({ "kb_per_frame": null })
        );
    }

    #[test]
    fn runs_benches_and_the_paper_are_found_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let steps = "[[steps]]\nname = 'run'\nprogram = 'realo'\nargs = ['run', '--out={out}']\n\
                     [[steps]]\nname = 'nms'\nprogram = 'realo-lab'\nargs = ['bench', 'nms', '--json']\n";
        let page = toml::from_str(&format!("title = 'T'\nkind = 'scores'\nabout = 'A'\n{steps}")).unwrap();
        let plan = Plan::new("p", &page).unwrap();
        let run = folder.path().join("target/realo/measured/p/run/late_fusion");
        fs::create_dir_all(&run).unwrap();
        fs::write(
            run.join("result.json"),
            r#"{ "isa": "f32 on portable", "frames": { "total": 1 } }"#,
        )
        .unwrap();
        fs::write(run.join("timing.json"), r#"{ "rate_hz": 10 }"#).unwrap();
        let printed = plan.printed(&plan.jobs[1], folder.path());
        fs::create_dir_all(printed.parent().unwrap()).unwrap();
        fs::write(printed, r#"{ "cpu": "x" }"#).unwrap();
        let paper = json!({ "online": { "late": [1, 2] } });
        let results = Results::new(&plan, folder.path(), &paper);
        assert_eq!(results.find("paper:online/late").unwrap(), json!([1, 2]));
        assert_eq!(results.find("nms").unwrap(), json!({ "cpu": "x" }));
        assert_eq!(results.find("nms:cpu").unwrap(), "x");
        assert_eq!(results.find("run/late_fusion").unwrap()["timing"]["rate_hz"], 10);
        let names = ["run/late_fusion", "nms", "paper:online/late"].map(String::from);
        assert_eq!(results.instructions(names.into_iter()).unwrap(), ["f32 on portable"]);
        assert!(
            results
                .find("other")
                .unwrap_err()
                .to_string()
                .contains("there is no step `other`")
        );
        for (text, part) in [(None, "run/no_fusion/result.json"), (Some("{ \"isa\": "), "EOF")] {
            let damaged = folder.path().join("target/realo/measured/p/run/no_fusion");
            fs::create_dir_all(&damaged).unwrap();
            if let Some(text) = text {
                fs::write(damaged.join("result.json"), text).unwrap();
            }
            let error = format!("{:#}", results.find("run/no_fusion").unwrap_err());
            assert!(error.contains(part) && error.contains("--fresh"), "{error}");
        }
    }
}
