//! The timing claims, as a markdown table on stdout: arrays to displacements, next plans, memory.
//!
//! `MTM_BENCH_SIZES=20000,80000,300000 cargo bench -p mtm-benches --bench claims`
//!
//! Each line of the table runs in a process of its own, so that its peak memory is its own.
//! `MTM_BENCH_REPEATS` (3) is how often whole runs repeat. Times are the median, with the smallest and
//! largest.

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

#[path = "../scenes/scene.rs"]
mod scene;
#[path = "../scenes/shell.rs"]
mod shell;

use std::collections::BTreeMap;
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

use mtm_core::{MassTensors, Method, StaticOptions, StaticSolver};
use shell::Shell;

/// First argument of a process that measures one line.
const CHILD: &str = "--measure";
/// Plans solved one after another, and applications of an operator.
const NEXT_PLANS: usize = 9;
const OPERATOR_PLANS: usize = 101;
/// Distance between the mean skin displacements of two methods above which they disagree, mm.
const AGREEMENT: f64 = 1e-6;

/// The lines measured at each size: name, method, whether teeth and mucosa slide.
const LINES: [(&str, Method, bool); 4] = [
    ("cholesky", Method::Cholesky, false),
    ("pcg", Method::Pcg, false),
    ("cholesky, sliding", Method::Cholesky, true),
    ("pcg, sliding", Method::Pcg, true),
];

/// Median, smallest and largest of repeated times, s.
#[derive(Clone, Copy)]
struct Times {
    median: f64,
    least: f64,
    most: f64,
}

impl Times {
    fn of(mut seconds: Vec<f64>) -> Self {
        seconds.sort_by(f64::total_cmp);
        let [least, .., most] = seconds[..] else {
            return Self { median: seconds[0], least: seconds[0], most: seconds[0] };
        };
        Self { median: seconds[seconds.len() / 2], least, most }
    }

    fn print(self, key: &str) {
        println!("{key} {:e} {:e} {:e}", self.median, self.least, self.most);
    }

    /// Three digits with a unit that suits them.
    fn show(self) -> String {
        let (scale, unit) = match self.median {
            s if s < 1e-3 => (1e6, "µs"),
            s if s < 1.0 => (1e3, "ms"),
            _ => (1.0, "s"),
        };
        let [a, b, c] = [self.median, self.least, self.most].map(|s| three_digits(s * scale));
        format!("{a} {unit} ({b}–{c})")
    }
}

fn three_digits(x: f64) -> String {
    let decimals = (2 - x.abs().log10().floor() as i32).clamp(0, 3) as usize;
    format!("{x:.decimals$}")
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().position(|a| a == CHILD) {
        Some(at) => {
            let number = |k: usize| -> usize {
                arguments[at + k].parse().expect("the parent passes numbers")
            };
            measure(number(1), number(2));
        }
        None => report(),
    }
}

fn repeats() -> usize {
    std::env::var("MTM_BENCH_REPEATS").ok().and_then(|s| s.parse().ok()).unwrap_or(3)
}

/// Measures line `line` at a size and prints its figures for the parent, one a line.
fn measure(n_tets: usize, line: usize) {
    let (_, method, sliding) = LINES[line];
    let shell = Shell::generate(n_tets);
    println!("tets {}", shell.tets.len());
    println!("arrays_mb {}", peak_mb());
    let options = StaticOptions { method, ..StaticOptions::default() };
    let run = || {
        let tensors = MassTensors::new(scene::mesh(&shell), scene::tissue(&shell));
        let tensors = Arc::new(tensors.expect("matching tissue"));
        let boundary = scene::boundary(&shell, sliding);
        let solver = StaticSolver::new(tensors, boundary, options, &|| false)
            .unwrap_or_else(|e| fail(&e.to_string()));
        let found = solver.solve(&scene::plan(&shell, 0), None, &|| false);
        (solver, found.unwrap_or_else(|e| fail(&e.to_string())))
    };
    let mut seconds = Vec::new();
    let mut last = None;
    for _ in 0..repeats() {
        drop(last.take());
        let begin = Instant::now();
        last = Some(run());
        seconds.push(begin.elapsed().as_secs_f64());
    }
    Times::of(seconds).print("whole");
    let Some((solver, found)) = last else { return };
    println!("unknowns {}", solver.n_unknowns());
    println!("sliding {}", found.contact.nodes.len());
    println!("error_estimate {:e}", found.error_estimate);
    let skin: f64 = shell
        .skin
        .iter()
        .map(|&j| found.displacements[j as usize].iter().map(|v| v * v).sum::<f64>().sqrt())
        .sum();
    println!("skin {:.12}", skin / shell.skin.len() as f64);

    let mut contact_iterations = 0;
    let next = (1..=NEXT_PLANS).map(|step| {
        let plan = scene::plan(&shell, step);
        let begin = Instant::now();
        let found = solver.solve(&plan, None, &|| false);
        let elapsed = begin.elapsed().as_secs_f64();
        contact_iterations = found.unwrap_or_else(|e| fail(&e.to_string())).contact_iterations;
        elapsed
    });
    Times::of(next.collect()).print("next");
    println!("contact_iterations {contact_iterations}");
    println!("peak_mb {}", peak_mb());
    if method == Method::Cholesky {
        let begin = Instant::now();
        let operator = solver
            .plan_operator(Some(shell.skin.clone()), None, &|| false)
            .unwrap_or_else(|e| fail(&e.to_string()));
        Times::of(vec![begin.elapsed().as_secs_f64()]).print("operator_set_up");
        let mut out = vec![[0.0; 3]; shell.skin.len()];
        let applied = (0..OPERATOR_PLANS).map(|step| {
            let plan = scene::plan(&shell, step % 10);
            let begin = Instant::now();
            operator.apply_into(&plan, &mut out).unwrap_or_else(|e| fail(&e.to_string()));
            begin.elapsed().as_secs_f64()
        });
        Times::of(applied.collect()).print("operator");
    }
}

/// Tells the parent why a line has no figures.
fn fail(message: &str) -> ! {
    println!("failed {message}");
    std::process::exit(0)
}

/// Largest memory of this process so far, MB; 0 where the system does not say.
fn peak_mb() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()?.parse::<usize>().ok()).unwrap_or(0) >> 10
}

/// Figures of one line at one size.
type Figures = BTreeMap<String, String>;

fn run_child(n_tets: usize, line: usize) -> Figures {
    let program = std::env::current_exe().expect("the path of this program");
    let output = Command::new(program)
        .args([CHILD, &n_tets.to_string(), &line.to_string()])
        .output()
        .expect("a process of its own");
    let text = String::from_utf8_lossy(&output.stdout);
    let mut figures: Figures = text
        .lines()
        .filter_map(|l| l.split_once(' '))
        .map(|(key, value)| (key.to_owned(), value.to_owned()))
        .collect();
    if !output.status.success() {
        figures.insert("failed".into(), format!("the process ended with {}", output.status));
    }
    figures
}

fn number(figures: &Figures, key: &str) -> Option<f64> {
    figures.get(key)?.parse().ok()
}

fn times(figures: &Figures, key: &str) -> Option<Times> {
    let values: Vec<f64> =
        figures.get(key)?.split(' ').map(str::parse).collect::<Result<_, _>>().ok()?;
    let [median, least, most] = values[..] else { return None };
    Some(Times { median, least, most })
}

fn report() {
    let sizes = scene::sizes();
    println!("{}\n", circumstances());
    println!(
        "| tets | unknowns | sliding nodes | method | arrays to displacements | next plan | \
         contact iterations | operator set-up | operator per plan (skin) | peak MB (arrays alone) | \
         estimated error, mm |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    let mut whole: Vec<Vec<(f64, f64)>> = vec![Vec::new(); LINES.len()];
    for &n_tets in &sizes {
        let mut skins: Vec<(bool, f64)> = Vec::new();
        for (line, &(name, _, sliding)) in LINES.iter().enumerate() {
            let f = run_child(n_tets, line);
            let text = |key: &str| f.get(key).cloned().unwrap_or_else(|| "–".into());
            let time = |key: &str| times(&f, key).map_or_else(|| "–".into(), Times::show);
            if let Some(why) = f.get("failed") {
                println!("| {} | | | {name} | {why} | | | | | | |", text("tets"));
                continue;
            }
            println!(
                "| {} | {} | {} | {name} | {} | {} | {} | {} | {} | {} ({}) | {:.1e} |",
                text("tets"),
                text("unknowns"),
                text("sliding"),
                time("whole"),
                time("next"),
                text("contact_iterations"),
                time("operator_set_up"),
                time("operator"),
                text("peak_mb"),
                text("arrays_mb"),
                number(&f, "error_estimate").unwrap_or(f64::NAN)
            );
            if let (Some(n), Some(t)) = (number(&f, "tets"), times(&f, "whole")) {
                whole[line].push((n, t.median));
            }
            if let Some(skin) = number(&f, "skin") {
                for &(_, other) in skins.iter().filter(|(s, _)| *s == sliding) {
                    let apart = (skin - other).abs();
                    if apart > AGREEMENT {
                        println!("\n**{name} at {n_tets} tets differs by {apart:.1e} mm.**\n");
                    }
                }
                skins.push((sliding, skin));
            }
        }
    }
    println!();
    for (line, points) in LINES.iter().zip(&whole) {
        if let Some(exponent) = fitted_exponent(points) {
            println!(
                "Arrays to displacements by {} grow like n^{exponent:.2} over {} sizes.",
                line.0,
                points.len()
            );
        }
    }
}

/// Least-squares slope of log time over log size.
fn fitted_exponent(points: &[(f64, f64)]) -> Option<f64> {
    if points.len() < 2 {
        return None;
    }
    let count = points.len() as f64;
    let logs: Vec<(f64, f64)> = points.iter().map(|(n, t)| (n.ln(), t.ln())).collect();
    let mean = |pick: fn(&(f64, f64)) -> f64| logs.iter().map(pick).sum::<f64>() / count;
    let (x, y) = (mean(|p| p.0), mean(|p| p.1));
    let top: f64 = logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    let bottom: f64 = logs.iter().map(|p| (p.0 - x).powi(2)).sum();
    Some(top / bottom)
}

/// Machine, threads, commit and load: without them a time means nothing.
fn circumstances() -> String {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let info = read("/proc/cpuinfo");
    let processor = info
        .lines()
        .find_map(|l| l.strip_prefix("model name"))
        .map_or("unknown processor", |l| l.trim_start_matches([' ', '\t', ':']));
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok()?;
        let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        output.status.success().then_some(text)
    };
    let commit = git(&["rev-parse", "--short", "HEAD"]).unwrap_or_else(|| "unknown".into());
    let changed = git(&["status", "--porcelain", "--untracked-files=no"]);
    let dirty = if changed.is_none_or(|s| s.is_empty()) { "" } else { " with changes" };
    let load = read("/proc/loadavg");
    format!(
        "{processor}, {} processors, {} threads; commit {commit}{dirty}; ordering by METIS; load \
         {} before the run; whole runs {} times, median (smallest–largest).",
        std::thread::available_parallelism().map_or(0, usize::from),
        rayon::current_num_threads(),
        load.split(' ').next().unwrap_or("unknown"),
        repeats()
    )
}
