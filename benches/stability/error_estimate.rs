//! How often the reported error of a solve is less than its true error, over random scenes whose moduli
//! differ up to 1e10 times, as a markdown table on stdout.
//!
//! `cargo bench -p mtm-benches --bench error_estimate -- --scenes 20000 --seed 1`
//!
//! `--nodes N` (3000) is the size of the largest scene; `--only I` solves one scene and prints it. The exit
//! status is 1 if any estimate failed.

#[path = "../../tests/rust/meshes/mod.rs"]
#[allow(clippy::unwrap_used)] // as in the tests, which share them
mod meshes;
#[path = "../scenes/random_scenes.rs"]
mod random_scenes;

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use mtm_core::{Method, MtmError};
use rayon::prelude::*;

use random_scenes::{Scene, farthest, largest, refusal};

/// Roundings of the largest displacement that storing the answer costs.
const ROUNDINGS: f64 = 4.0;
/// One scene in so many has its reference checked by the second way.
const CHECKED: u64 = 40;
/// Nodes up to which the second way is quick.
const CHECKED_NODES: usize = 400;
/// Distance between the two references over the displacements that counts as agreement.
const AGREEMENT: f64 = 1e-15;
const METHODS: [Method; 2] = [Method::Pcg, Method::Cholesky];
const DECADES: usize = 10;

struct Options {
    scenes: u64,
    seed: u64,
    nodes: usize,
    only: Option<u64>,
}

/// Why a method refused, in a few words.
type Reason = &'static str;

/// What became of one scene with one method.
#[derive(Clone, Copy)]
enum Outcome {
    Refused(Reason),
    /// True and reported error, mm, and the iterations.
    Solved {
        error: f64,
        reported: f64,
        iterations: usize,
        allowed: f64,
    },
}

/// What became of one scene.
struct Judged {
    index: u64,
    decade: usize,
    outcomes: [Outcome; 2],
    description: String,
}

enum Verdict {
    Judged(Judged),
    /// The mesh or the boundary of the drawn scene was refused.
    Unbuilt,
    /// No reference, and every method refused as well.
    AllRefused(usize, [Reason; 2]),
    /// No reference, but an answer.
    Unverified(u64, String),
}

#[derive(Default, Clone)]
struct Count {
    scenes: usize,
    refused: usize,
    failed: usize,
    worst: f64,
    /// Reported over true error where it holds and the error is above rounding.
    margins: Vec<f64>,
    iterations: usize,
    reasons: BTreeMap<Reason, usize>,
}

fn main() -> ExitCode {
    let options = match arguments() {
        Ok(options) => options,
        Err(problem) => {
            eprintln!("{problem}");
            return ExitCode::from(2);
        }
    };
    let checked = AtomicUsize::new(0);
    let apart = Mutex::new(0.0_f64);
    let indices: Vec<u64> = options.only.map_or((0..options.scenes).collect(), |i| vec![i]);
    let verdicts: Vec<Verdict> = indices
        .par_iter()
        .with_max_len(1)
        .map(|&index| judge(&options, index, &checked, &apart))
        .collect();
    let apart = apart.into_inner().unwrap_or_default();
    println!(
        "{} scenes, seed {}, up to {} nodes; {} references checked by a second way: at most {apart:.1e} \
         of the displacements apart\n",
        verdicts.len(),
        options.seed,
        options.nodes,
        checked.into_inner()
    );
    let failed = report(&verdicts);
    if failed > 0 || apart > AGREEMENT { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

fn arguments() -> Result<Options, String> {
    let mut options = Options { scenes: 2000, seed: 1, nodes: 3000, only: None };
    let mut words = std::env::args().skip(1).filter(|w| w != "--bench");
    while let Some(word) = words.next() {
        let value = words.next().ok_or_else(|| format!("{word} needs a number"))?;
        let number: u64 = value.parse().map_err(|e| format!("{word} {value}: {e}"))?;
        match word.as_str() {
            "--scenes" => options.scenes = number,
            "--seed" => options.seed = number,
            "--nodes" => options.nodes = (number as usize).max(60),
            "--only" => options.only = Some(number),
            _ => return Err(format!("{word} is unknown: use --scenes, --seed, --nodes, --only")),
        }
    }
    Ok(options)
}

fn reason(error: &MtmError) -> Reason {
    match error {
        MtmError::NotConverged { shortfall, .. } => shortfall.quantity,
        _ => "the matrix is not positive definite to working precision",
    }
}

fn judge(options: &Options, index: u64, checked: &AtomicUsize, apart: &Mutex<f64>) -> Verdict {
    let Ok(scene) = Scene::random(options.seed, index, options.nodes) else {
        return Verdict::Unbuilt;
    };
    let decade = (scene.decades as usize).min(DECADES - 1);
    if options.only.is_some() {
        println!("{}", scene.description);
    }
    let solved = METHODS.map(|method| scene.solve(method));
    for (method, solved) in METHODS.iter().zip(&solved) {
        if let Err(error) = solved {
            if options.only.is_some() {
                println!("{}: {error}", method.name());
            }
            if !refusal(error) {
                return Verdict::Unbuilt;
            }
        }
    }
    if solved.iter().all(Result::is_err) {
        return Verdict::AllRefused(decade, solved.map(|s| s.err().as_ref().map_or("", reason)));
    }
    let Some(exact) = scene.reference() else {
        return Verdict::Unverified(index, scene.description);
    };
    let size = largest(&exact);
    if index.is_multiple_of(CHECKED)
        && exact.len() <= CHECKED_NODES
        && let Some(other) = scene.factored_in_pairs()
    {
        checked.fetch_add(1, Ordering::Relaxed);
        if let Ok(mut apart) = apart.lock() {
            *apart = apart.max(farthest(&exact, &other) / size.max(f64::MIN_POSITIVE));
        }
    }
    let outcomes = solved.map(|solved| match solved {
        Err(error) => Outcome::Refused(reason(&error)),
        Ok(found) => Outcome::Solved {
            error: farthest(&found.displacements, &exact),
            reported: found.error_estimate,
            iterations: found.iterations,
            allowed: ROUNDINGS * f64::EPSILON * size,
        },
    });
    if options.only.is_some() {
        for (method, outcome) in METHODS.iter().zip(&outcomes) {
            if let Outcome::Solved { error, reported, iterations, .. } = outcome {
                println!(
                    "{}: error {error:.3e} mm, reported {reported:.3e} mm, largest displacement \
                     {size:.3e} mm, {iterations} iterations",
                    method.name()
                );
            }
        }
    }
    Verdict::Judged(Judged { index, decade, outcomes, description: scene.description })
}

/// Prints the tables; how many estimates failed.
fn report(verdicts: &[Verdict]) -> usize {
    let mut counts = vec![vec![Count::default(); DECADES]; METHODS.len()];
    let (mut unbuilt, mut failures) = (0, Vec::new());
    let mut unverified = Vec::new();
    for verdict in verdicts {
        match verdict {
            Verdict::Unbuilt => unbuilt += 1,
            Verdict::Unverified(index, description) => unverified.push((index, description)),
            Verdict::AllRefused(decade, reasons) => {
                for (counts, reason) in counts.iter_mut().zip(reasons) {
                    counts[*decade].add(Outcome::Refused(reason));
                }
            }
            Verdict::Judged(judged) => {
                for (m, outcome) in judged.outcomes.iter().enumerate() {
                    if let Some(failure) = counts[m][judged.decade].add(*outcome) {
                        failures.push((failure, m, judged));
                    }
                }
            }
        }
    }
    for (method, counts) in METHODS.iter().zip(&counts) {
        println!("{}:\n", method.name());
        println!(
            "| contrast | scenes | refused | too small | worst, true / reported | median, reported / \
             true | iterations |"
        );
        println!("|---|---|---|---|---|---|---|");
        for (decade, count) in counts.iter().enumerate() {
            count.print(&format!("1e{decade} to 1e{}", decade + 1));
        }
        let mut all = Count::default();
        for count in counts {
            all.scenes += count.scenes;
            all.refused += count.refused;
            all.failed += count.failed;
            all.worst = all.worst.max(count.worst);
            all.iterations += count.iterations;
            all.margins.extend(&count.margins);
            for (reason, count) in &count.reasons {
                *all.reasons.entry(reason).or_default() += count;
            }
        }
        all.print("all");
        println!();
        for (reason, count) in &all.reasons {
            println!("- refused {count} times: {reason}");
        }
        println!();
    }
    println!("{unbuilt} drawn scenes could not be built; {} had no reference", unverified.len());
    for (index, description) in unverified.iter().take(20) {
        println!("  no reference: scene {index}: {description}");
    }
    failures.sort_by(|a, b| b.0.total_cmp(&a.0));
    for (ratio, method, judged) in failures.iter().take(40) {
        println!(
            "  {} is {ratio:.1e} times too small: scene {}: {}",
            METHODS[*method].name(),
            judged.index,
            judged.description
        );
    }
    failures.len()
}

impl Count {
    /// Counts an outcome; how many times too small its estimate was, if it was.
    fn add(&mut self, outcome: Outcome) -> Option<f64> {
        self.scenes += 1;
        let (error, reported, iterations, allowed) = match outcome {
            Outcome::Solved { error, reported, iterations, allowed } => {
                (error, reported, iterations, allowed)
            }
            Outcome::Refused(reason) => {
                self.refused += 1;
                *self.reasons.entry(reason).or_default() += 1;
                return None;
            }
        };
        self.iterations += iterations;
        let ratio = error / reported.max(f64::MIN_POSITIVE);
        let holds = error <= reported + allowed;
        if error > allowed {
            self.worst = self.worst.max(ratio);
            self.margins.push(1.0 / ratio);
        }
        if holds {
            return None;
        }
        self.failed += 1;
        Some(ratio)
    }

    fn print(&self, name: &str) {
        let mut margins = self.margins.clone();
        margins.sort_by(f64::total_cmp);
        let median = margins.get(margins.len() / 2).copied().unwrap_or(f64::NAN);
        let solved = self.scenes - self.refused;
        println!(
            "| {name} | {} | {} | {} | {:.1e} | {median:.1e} | {:.0} |",
            self.scenes,
            self.refused,
            self.failed,
            self.worst,
            self.iterations as f64 / solved.max(1) as f64,
        );
    }
}
