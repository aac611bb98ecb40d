//! The virtual driver, the shipped operators and the results against a naive re-statement of `docs/architecture.md` (One engine, Accounting)
//! (accounting), over random logs, links and compute profiles: every Selection, every fusion and every term must agree.
//!
//! `REALO_ORACLE_SEED=17` runs that world alone.

#[path = "oracle/account.rs"]
mod account;
#[path = "oracle/bank.rs"]
mod bank;
#[path = "oracle/draw.rs"]
mod draw;
#[path = "oracle/driver.rs"]
mod driver;
#[path = "oracle/link.rs"]
mod link;
#[path = "oracle/naive.rs"]
mod naive;
#[path = "oracle/stage.rs"]
mod stage;
#[path = "oracle/world.rs"]
mod world;

use std::collections::BTreeMap;
use std::path::Path;

use account::{Account, Reached};
use world::World;

const SEEDS: u64 = 4000;
/// Every so many worlds the node `results` runs as well; it writes files, which takes longest.
const WITH_RESULTS: u64 = 100;

/// One world: the account that both sides agree on, and what of it is rare.
fn agreed(seed: u64, folder: &Path) -> Result<(Account, Reached), String> {
    let world = World::of(seed);
    let driver = driver::account(seed, &world, folder, seed.is_multiple_of(WITH_RESULTS))?;
    let (oracle, reached) = naive::account(&world);
    for (channel, line) in oracle.channels.iter().filter(|(_, line)| line.accounted) {
        let sum: u64 = line.terms().iter().map(|(_, count)| count).sum();
        assert_eq!(
            line.sent, sum,
            "the oracle counts each message once: seed {seed}, {channel}"
        );
    }
    match driver.difference(&oracle) {
        None => Ok((driver, reached)),
        Some(difference) => Err(difference),
    }
}

/// All worlds on as many threads as there are processors, by seed.
fn all(seeds: std::ops::Range<u64>) -> BTreeMap<u64, Result<(Account, Reached), String>> {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let run = |thread: usize| {
        let folder = tempfile::tempdir().expect("a folder can be made");
        let seeds = seeds.clone().skip(thread).step_by(threads);
        seeds
            .map(|seed| (seed, agreed(seed, folder.path())))
            .collect::<Vec<_>>()
    };
    std::thread::scope(|scope| {
        let run = &run;
        let threads: Vec<_> = (0..threads).map(|thread| scope.spawn(move || run(thread))).collect();
        threads
            .into_iter()
            .flat_map(|thread| thread.join().expect("no world panics"))
            .collect()
    })
}

#[test]
fn naive_restatement_agrees_with_virtual_time() {
    let alone = std::env::var("REALO_ORACLE_SEED")
        .ok()
        .map(|seed| seed.parse().expect("a seed is a number"));
    let seeds = alone.map_or(0..SEEDS, |seed| seed..seed + 1);
    let accounts = all(seeds);
    let failed: Vec<_> = accounts
        .iter()
        .filter_map(|(seed, account)| Some((seed, account.as_ref().err()?)))
        .collect();
    let smallest = failed.iter().min_by_key(|(seed, _)| World::of(**seed).sweeps.len());
    if let Some((seed, difference)) = smallest {
        let seeds: Vec<_> = failed.iter().map(|(seed, _)| *seed).take(20).collect();
        let world = World::of(**seed);
        panic!(
            "{} worlds differ: {seeds:?} …; the smallest is seed {seed}: {difference}\n{world:#?}",
            failed.len()
        );
    }
    if alone.is_none() {
        covers_every_term(accounts.values().flatten());
        reaches_what_is_rare(accounts.values().flatten().map(|(_, reached)| reached));
    }
}

/// Agreement says nothing about what never happens.
fn covers_every_term<'a>(accounts: impl Iterator<Item = &'a (Account, Reached)>) {
    let mut totals: BTreeMap<String, u64> = BTreeMap::new();
    let mut add = |what: &str, count: u64| *totals.entry(what.into()).or_default() += count;
    for (account, _) in accounts {
        for (channel, line) in &account.channels {
            let what = match channel.split(['-', '.']).collect::<Vec<_>>()[..] {
                [_, _, "agent_state"] if line.accounted => "the ego's states",
                [_, _, "agent_state"] => continue,
                _ => "sweeps",
            };
            for (term, count) in line.terms() {
                // A sender takes any state, however old, and no state is refused. No graph here has a guard.
                let happens = what == "sweeps" || !["over_limit", "stale", "rejected"].contains(&term);
                let happens = happens && term != "distrusted";
                happens.then(|| add(&format!("{what}: {term}"), count));
            }
            add(&format!("{what}: sent"), line.sent);
            add(&format!("{what}: out_of_range"), line.out_of_range);
            add(&format!("{what}: duplicated"), line.duplicated);
        }
        add("selections", account.selections.len() as u64);
        add("fusions", account.fusions.len() as u64);
        add("sweeps without a known ego", account.no_ego_state);
        for (stage, count) in account
            .skipped
            .iter()
            .filter(|(stage, _)| !["link", "state-link", "bank"].contains(&&***stage))
        {
            add(&format!("skipped by {stage}"), *count);
        }
    }
    println!("{totals:#?}");
    assert!(
        totals.values().all(|count| *count >= SEEDS / 8),
        "too little of something: {totals:#?}"
    );
}

/// How often, at least, over all worlds.
const RARE: [(&str, u64); 17] = [
    ("answers that the bank's limit changed", 200),
    ("answers offline that the bank's limit changed", 100),
    ("worlds in which a link's room ran out", 20),
    ("projected with a state that the link made old", 1000),
    ("fusions of what was projected and stayed as sent", 500),
    ("fusions of what was projected and brought up to date", 500),
    ("queries that waited", 800),
    ("messages due after a gap in their seq", 100),
    ("messages due after a period without one", 100),
    ("waits that a message ended", 300),
    ("waits that the last of several ended", 40),
    ("waits that an older message did not end", 20),
    ("waits that ran out", 300),
    ("waits that the next query ended", 150),
    ("answers that waiting changed", 400),
    ("queries whose patience was over at their turn", 50),
    ("answers with what came while they were in line", 300),
];

fn reaches_what_is_rare<'a>(worlds: impl Iterator<Item = &'a Reached>) {
    let mut totals: BTreeMap<&str, [u64; 2]> = BTreeMap::new();
    for (what, count) in worlds.flatten() {
        let [times, in_worlds] = totals.entry(what).or_default();
        *times += count;
        *in_worlds += u64::from(*count > 0);
    }
    println!("times, and in how many worlds: {totals:#?}");
    for (what, min) in RARE {
        let [times, in_worlds] = totals.get(what).copied().unwrap_or_default();
        assert!(
            times >= min && in_worlds >= 20,
            "{what}: {times} times in {in_worlds} worlds, expected {min} in 20"
        );
    }
}
