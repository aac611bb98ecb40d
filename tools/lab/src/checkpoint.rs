//! `realo-lab checkpoint`: from PyTorch's checkpoints to models.

use std::path::PathBuf;

use clap::Subcommand;
use clap::builder::{PossibleValue, PossibleValuesParser};
use eyre::Result;
use realo_checkpoint::{Checkpoint, Written};
use realo_cli::Outcome;
use realo_cli::program::called_beside;
use realo_logs::shell;
use realo_methods::Model;

/// Reads checkpoints that PyTorch wrote, without running what is in them
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand)]
enum Action {
    /// Makes a model of a checkpoint of OpenCOOD or V2X-Real: weights, and a model file beside them
    Convert(Convert),
    /// Lists the tensors of a checkpoint or a safetensors file, and says whose they are
    Show {
        /// A .pth file, or a .safetensors file
        file: PathBuf,
    },
}

#[derive(clap::Args)]
struct Convert {
    /// What torch.save wrote: a state dict, plain or beside an optimizer
    checkpoint: PathBuf,
    /// The weights to write; the model file gets the same name with .toml
    #[arg(short = 'o', long = "output")]
    output: PathBuf,
    /// V2X-Real's network at full size; its compressor is recognised by the checkpoint
    #[arg(long, value_parser = networks(), required_unless_present = "model")]
    arch: Option<String>,
    /// Model file of a network of another size
    #[arg(long, conflicts_with = "arch")]
    model: Option<PathBuf>,
    /// Replace files that are there
    #[arg(long)]
    force: bool,
}

/// The networks of V2X-Real, by their names in model files.
fn networks() -> PossibleValuesParser {
    let models = realo_methods::full::models().into_iter();
    PossibleValuesParser::new(models.map(|model| PossibleValue::new(model.arch.name()).help(model.arch.title())))
}

/// Converts, or prints a table.
pub fn main(args: &Args) -> Result<Outcome> {
    match &args.action {
        Action::Convert(convert) => convert.run()?,
        Action::Show { file } => println!("{}", realo_checkpoint::list(file)?),
    }
    Ok(Outcome::Complete)
}

impl Convert {
    fn run(&self) -> Result<()> {
        let mut checkpoint = Checkpoint::open(&self.checkpoint)?;
        let model = match (&self.model, &self.arch) {
            (Some(file), _) => Model::read(file)?,
            (None, arch) => arch
                .as_deref()
                .and_then(|arch| realo_checkpoint::full_size(&checkpoint, arch))
                .expect("clap asks for one of the networks"),
        };
        let converted = realo_checkpoint::convert(&mut checkpoint, model)?;
        let written = realo_checkpoint::write(&converted, &self.output, self.model.as_deref(), self.force)?;
        let [tensors, numbers] = written.tensors;
        println!(
            "{}: {tensors} tensors with {numbers} numbers of {}",
            written.weights.display(),
            converted.origin
        );
        let left_out = checkpoint.left_out();
        if !left_out.is_empty() {
            let names: Vec<String> = left_out
                .iter()
                .take(8)
                .map(|name| format!("`{}`", name.escape_debug()))
                .collect();
            let more = if left_out.len() > names.len() { ", …" } else { "" };
            println!(
                "left out, for they are not the network's: {}{more} ({} in all)",
                names.join(", "),
                left_out.len()
            );
        }
        if !written.model_was_there {
            let (file, of) = (written.model.display(), &converted.model.name);
            println!(
                "{file}: grid, anchors and thresholds, which no checkpoint tells, are those of `{of}`: look at them"
            );
        }
        println!("run it: {}", next(&converted.model, &written));
        Ok(())
    }
}

/// The command that runs a model; those of V2X-Real were trained on points in the ego's frame.
fn next(model: &Model, written: &Written) -> String {
    let arch = model.arch.to_string();
    let graph = match &*arch {
        "pointpillars" => "early_fusion",
        // The graph's fusion is the model's.
        "v2vnet" => "attfuse",
        arch => arch,
    };
    let file = shell::word(&written.model);
    let realo = called_beside("realo");
    format!("{realo} run dataflows/{graph}.yml --offline --project sender --model {file}")
}
