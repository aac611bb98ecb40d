use std::fs;

use super::*;
use crate::measure::provenance::Machine;

const PAGE: &str = r#"
title = "A page"
kind = "scores"
about = "Of {seeds} seeds."
weights = ["models/lite.safetensors"]
parameters = { seeds = 3 }

[[steps]]
name = "logs"
program = "realo-lab"
args = ["simulate", "--seed", "{seed}", "-o", "{out}.mcap"]
output = "{out}.mcap"
each = { variable = "seed", from = 900, count = "seeds" }

[[steps]]
name = "runs"
program = "realo"
args = ["run", "late_fusion", "--log={logs}", "--data={env:HOME}/a b", "--out", "{out}"]

[columns.rate]
title = "rate"
about = "Frames a second."
paths = ["/timing/rate_hz"]
format = "0.0"

[[tables]]
title = "A table"
about = "Of all {seeds}."
readme = true
head = "strategy"
columns = ["rate"]
rows = [{ label = "late fusion", run = "runs" }]
"#;

fn with_sheet<T>(used: impl Fn(&Sheet) -> T) -> T {
    let folder = tempfile::tempdir().unwrap();
    let page: Page = toml::from_str(PAGE).unwrap();
    let plan = Plan::new("p", &page).unwrap();
    let run = folder.path().join(plan.place("runs"));
    fs::create_dir_all(&run).unwrap();
    fs::write(run.join("result.json"), r#"{ "isa": "f32 on portable" }"#).unwrap();
    fs::write(run.join("timing.json"), r#"{ "rate_hz": 10 }"#).unwrap();
    let paper = serde_json::Value::Null;
    used(&Sheet {
        page: &page,
        plan: &plan,
        results: &Results::new(&plan, folder.path(), &paper),
        columns: &BTreeMap::new(),
    })
}

#[test]
fn curves_of_a_sweep_are_drawn_and_listed() {
    let folder = tempfile::tempdir().unwrap();
    let sweep = "[[steps]]\nname = 'delay'\nprogram = 'realo'\nargs = ['sweep', 'late_fusion', '-o', '{out}']\n\
                 [[curves]]\ntitle = 'Of {seeds} delays'\nabout = 'Ages.'\nstep = 'delay'\nsetting = 'link.delay_ms'\n";
    let head = "title = 'T'\nkind = 'scores'\nabout = 'A'\n[parameters]\nseeds = 3\n";
    let page: Page = toml::from_str(&format!("{head}{sweep}")).unwrap();
    let plan = Plan::new("ages", &page).unwrap();
    let paper = serde_json::Value::Null;
    let sheet = Sheet {
        page: &page,
        plan: &plan,
        results: &Results::new(&plan, folder.path(), &paper),
        columns: &BTreeMap::new(),
    };
    let error = format!("{:#}", sheet.markdown(&provenance(None)).unwrap_err());
    assert!(
        error.contains("link.delay_ms.md: expected what a sweep over `link.delay_ms` wrote"),
        "{error}"
    );
    let written = folder.path().join(plan.place("delay"));
    fs::create_dir_all(&written).unwrap();
    fs::write(
        written.join("link.delay_ms.md"),
        "| link.delay_ms | late_fusion |\n|---|---:|\n| 0 | 0.8 |\n",
    )
    .unwrap();
    let text = sheet.markdown(&provenance(None)).unwrap();
    let expected = "\n## Of 3 delays\n\nAges.\n\n![Of 3 delays](ages-delay.svg)\n\n| link.delay_ms | late_fusion |\n|---|---:|\n| 0 | 0.8 |\n";
    assert!(text.contains(expected), "{text}");
    let drawings = sheet.drawings().unwrap();
    assert_eq!(
        drawings,
        [("ages-delay.svg".to_string(), written.join("link.delay_ms.svg"))]
    );
}

fn provenance(machine: Option<Machine>) -> Provenance {
    Provenance {
        commit: "`abc`".into(),
        command: "realo-lab measure p".into(),
        weights: vec![("models/lite.safetensors".into(), "0123".into())],
        machine,
    }
}

#[test]
fn a_page_has_head_tables_columns_and_commands() {
    let text = with_sheet(|sheet| sheet.markdown(&provenance(None)).unwrap());
    let expected = r#"<!-- Written by `realo-lab measure p`: what is edited here is lost. -->
# A page

Of 3 seeds.

| | |
|---|---|
| figures | scores and bytes; every run in the same instructions gives the same digits |
| commit | `abc` |
| written by | `realo-lab measure p` |
| networks computed in | f32 on portable |
| sha256 of `models/lite.safetensors` | `0123` |

## A table

Of all 3.

| strategy | rate |
|---|---:|
| late fusion | 10.0 |

## Columns

- rate: Frames a second.

## Commands

```sh
for seed in $(seq 900 902); do realo-lab simulate --seed ${seed} -o target/realo/measured/p/logs/${seed}.mcap; done
realo run late_fusion $(printf -- '--log=%s ' target/realo/measured/p/logs/*.mcap) "--data=${HOME}/a b" --out target/realo/measured/p/runs
```
"#;
    assert_eq!(text, expected);
}

#[test]
fn only_pages_of_times_name_the_machine() {
    let machine = Machine {
        cpu: "EPYC".into(),
        threads: 2,
        instructions: "avx2".into(),
    };
    let text = with_sheet(|sheet| sheet.markdown(&provenance(Some(machine.clone()))).unwrap());
    assert!(
        text.contains("| CPU | EPYC, 2 threads |\n| instructions of the CPU | avx2 |\n"),
        "{text}"
    );
    let text = with_sheet(|sheet| sheet.markdown(&provenance(None)).unwrap());
    assert!(!text.contains("CPU"), "{text}");
}

#[test]
fn the_readme_has_a_table_of_the_page() {
    let table = with_sheet(|sheet| sheet.readme_table().unwrap().unwrap());
    assert_eq!(table, "| strategy | rate |\n|---|---:|\n| late fusion | 10.0 |\n");
}
