//! `realo keys`: keys of agents, and whom they trust.

use std::path::{Path, PathBuf};

use eyre::Result;
use realo_cli::{Force, Outcome, Output};
use realo_radio::keys::{Own, Trusted};

/// The public key of one agent.
const PUBLIC_KEY: Output = Output::Known {
    name: "the public key of one agent",
    begins: |head| {
        let text = str::from_utf8(head);
        text.is_ok_and(|text| Trusted::parse(text, Path::new("")).is_ok_and(|known| known.0.len() == 1))
    },
};

/// Makes keys by which agents sign what they send, and lists of those that are trusted
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    /// Makes a key for an agent: AGENT.key, which stays on its machine, and AGENT.pub for all others
    New {
        /// Its name
        agent: String,
        /// Folder of both files
        #[arg(short, long, default_value = ".")]
        output: PathBuf,
        #[command(flatten)]
        force: Force,
    },
    /// Writes AGENT.pub again beside a private key
    Public {
        /// What `realo keys new` made for the agent: AGENT.key
        key: PathBuf,
        #[command(flatten)]
        force: Force,
    },
    /// Adds agents to the list of those whose messages this agent takes
    Trust {
        /// AGENT.pub of other agents, as `realo keys new` made it there; or other such lists
        #[arg(required = true)]
        public: Vec<PathBuf>,
        /// The list; made where there is none
        #[arg(short, long, default_value = "trust.toml")]
        list: PathBuf,
    },
}

/// Writes the files, and says what they are for.
pub fn main(args: &Args) -> Result<Outcome> {
    match &args.command {
        Command::New { agent, output, force } => {
            let own = Own::new(agent)?;
            let private = output.join(format!("{agent}.key"));
            force.check(&public_of(&own, &private), PUBLIC_KEY)?;
            own.write(&private)?;
            if let Err(error) = write_public(&own, &private) {
                // Nobody knows it yet.
                std::fs::remove_file(&private)?;
                return Err(error);
            }
            println!(
                "{}: the private key, stays on the machine of {agent}: --set v2x.key={}",
                private.display(),
                private.display()
            );
        }
        Command::Public { key, force } => {
            let own = Own::read(key)?;
            force.check(&public_of(&own, key), PUBLIC_KEY)?;
            write_public(&own, key)?;
        }
        Command::Trust { public, list } => {
            let mut trusted = match list.exists() {
                true => Trusted::read(list)?,
                false => Trusted::default(),
            };
            for path in public {
                trusted.join(&Trusted::read(path)?, list)?;
            }
            trusted.write(list)?;
            let names: Vec<&str> = trusted.0.keys().map(|name| &**name).collect();
            println!(
                "{}: agents whose messages are taken: {}; --set v2x.trust={}",
                list.display(),
                names.join(", "),
                list.display()
            );
        }
    }
    Ok(Outcome::Complete)
}

/// The file with the public key, beside the private one.
fn public_of(own: &Own, private: &Path) -> PathBuf {
    private.with_file_name(format!("{}.pub", own.agent))
}

/// Writes what the others need beside a private key, and says so.
fn write_public(own: &Own, private: &Path) -> Result<()> {
    let agent = &own.agent;
    let public = public_of(own, private);
    own.public().write(&public)?;
    println!(
        "{}: the public key, copy it to the other agents and run there: realo keys trust {agent}.pub",
        public.display()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_another_kind_is_no_public_key() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("id.pub");
        std::fs::write(&file, "ssh-ed25519 AAAA me\n").unwrap();
        let said = Force::default().check(&file, PUBLIC_KEY).unwrap_err().to_string();
        assert!(said.contains("expected the public key of one agent"), "{said}");
        Own::new("cav1").unwrap().public().write(&file).unwrap();
        Force::default().check(&file, PUBLIC_KEY).unwrap();
    }
}
