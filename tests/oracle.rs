//! The virtual driver, the shipped operators and the results against a naive re-statement of DESIGN §4 (time) and §7
//! (accounting), over random logs, links and compute profiles: every Selection, every fusion and every term must agree.
//!
//! `REALO_ORACLE_SEED=17` runs that world alone.

#[path = "oracle/account.rs"]
mod account;
#[path = "oracle/driver.rs"]
mod driver;
#[path = "oracle/naive.rs"]
mod naive;
#[path = "oracle/world.rs"]
mod world;

use std::collections::BTreeMap;
use std::path::Path;

use account::Account;
use world::World;

const SEEDS: u64 = 4000;
/// Every so many worlds the node `results` runs as well; it writes files, which takes longest.
const WITH_RESULTS: u64 = 100;

/// One world: the account that both sides agree on.
fn agreed(seed: u64, folder: &Path) -> Result<Account, String> {
    let world = World::of(seed);
    let driver = driver::account(seed, &world, folder, seed.is_multiple_of(WITH_RESULTS))?;
    let oracle = naive::account(&world);
    for (from, line) in &oracle.channels {
        let sum: u64 = line.terms().iter().map(|(_, count)| count).sum();
        assert_eq!(
            line.sent, sum,
            "the oracle counts each message once: seed {seed}, {from}"
        );
    }
    match driver.difference(&oracle) {
        None => Ok(driver),
        Some(difference) => Err(difference),
    }
}

/// All worlds on as many threads as there are processors, by seed.
fn all(seeds: std::ops::Range<u64>) -> BTreeMap<u64, Result<Account, String>> {
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
    }
}

/// Agreement says nothing about what never happens.
fn covers_every_term<'a>(accounts: impl Iterator<Item = &'a Account>) {
    let mut totals: BTreeMap<String, u64> = BTreeMap::new();
    let mut add = |what: &str, count: u64| *totals.entry(what.into()).or_default() += count;
    for account in accounts {
        for line in account.channels.values() {
            line.terms().into_iter().for_each(|(term, count)| add(term, count));
            add("sent", line.sent);
            add("out_of_range", line.out_of_range);
            add("duplicated", line.duplicated);
        }
        add("selections", account.selections.len() as u64);
        add("fusions", account.fusions.len() as u64);
        for (stage, count) in account
            .passed_over
            .iter()
            .filter(|(stage, _)| !["link", "bank"].contains(&&***stage))
        {
            add(&format!("passed over by {stage}"), *count);
        }
    }
    println!("{totals:#?}");
    assert!(
        totals.values().all(|count| *count >= SEEDS / 4),
        "too little of something: {totals:#?}"
    );
}
