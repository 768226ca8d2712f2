//! The only error type of the crate: each variant states a fact, with the offending index and value.

mod kind;
mod ranges;
mod shortfall;

use thiserror::Error;

pub use kind::ErrorKind;
pub use ranges::LARGEST_COORDINATE;
pub(crate) use ranges::{check_coordinates, check_displacements, check_finite_rows, check_forces};
pub use shortfall::Shortfall;

/// What went wrong, where, how much, and what to do about it.
///
/// Variants belong to the families of [`ErrorKind`]; wrong input is detected at construction, a numerical
/// outcome (no convergence, a mechanism) is reported by the solver with the figures reached. Fields are the parts of
/// their message.
#[allow(missing_docs)]
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum MtmError {
    /// An array has no entries.
    #[error("{what} is empty: at least one entry is needed")]
    Empty { what: &'static str, kind: ErrorKind },
    /// Two arrays that belong together have different lengths.
    #[error("{what} has {found} entries where {expected} are needed ({why})")]
    Length { what: String, found: usize, expected: usize, why: &'static str, kind: ErrorKind },
    /// A value is NaN or infinite.
    #[error("{what}[{index}] is {value}: every value must be finite")]
    NotFinite { what: String, index: usize, value: f64, kind: ErrorKind },
    /// A value lies outside the allowed range.
    #[error("{what}[{index}] is {}: allowed is {allowed}", shown(*.value))]
    OutOfRange {
        what: String,
        /// Row of the offending value (0 for a scalar).
        index: usize,
        value: f64,
        allowed: &'static str,
        kind: ErrorKind,
    },
    /// An index points past the end of what it indexes.
    #[error("{what}[{row}] refers to {item} {index}, but there are {count} (allowed 0 to {}); is the file numbered from 1?", .count.saturating_sub(1))]
    IndexOutOfRange {
        what: String,
        row: usize,
        item: &'static str,
        index: usize,
        count: usize,
        kind: ErrorKind,
    },
    /// A tet names the same node twice.
    #[error(
        "tet {tet} names node {node} twice: nodes {nodes:?}; remove the tet or fix its connectivity"
    )]
    DuplicateNode { tet: usize, node: u32, nodes: [u32; 4] },
    /// A tet has negative volume.
    #[error(
        "tet {tet} is inverted: volume {volume:.6e}; swap two of its nodes {nodes:?} ({count} inverted tets in all)"
    )]
    InvertedTet { tet: usize, volume: f64, nodes: [u32; 4], count: usize },
    /// A tet has practically no volume.
    #[error(
        "tet {tet} is degenerate: volume {volume:.6e} for a longest edge of {edge:.6e}, below {limit:.1e} of its cube; remove or re-mesh it (nodes {nodes:?})"
    )]
    DegenerateTet { tet: usize, volume: f64, edge: f64, limit: f64, nodes: [u32; 4] },
    /// Two tets have the same four nodes.
    #[error(
        "tets {first} and {second} have the same four nodes {nodes:?}: remove one, or its stiffness counts twice"
    )]
    DuplicateTet {
        first: usize,
        second: usize,
        /// Their nodes, sorted.
        nodes: [u32; 4],
    },
    /// A node belongs to no tet.
    #[error(
        "node {node} belongs to no tet ({count} such nodes): remove unused nodes before building the mesh"
    )]
    UnusedNode { node: usize, count: usize },
    /// A triangle has no area.
    #[error("triangle {triangle} of {what} is degenerate: area {area:.3e}, vertices {vertices:?}")]
    DegenerateTriangle { what: String, triangle: usize, area: f64, vertices: [u32; 3] },
    /// A stiffness matrix is not symmetric.
    #[error(
        "stiffness of tet {tet} is not symmetric: C[{row}][{column}] = {upper:.6e} but C[{column}][{row}] = {lower:.6e}"
    )]
    AsymmetricStiffness {
        /// The tet (0 for a uniform tissue).
        tet: usize,
        row: usize,
        column: usize,
        upper: f64,
        lower: f64,
    },
    /// A material stores negative energy for some strain.
    #[error(
        "material of tet {tet} is indefinite: smallest eigenvalue {eigenvalue:.6e} MPa ({constants}); no stable solution exists with it"
    )]
    IndefiniteMaterial {
        /// The tet (0 for a uniform tissue).
        tet: usize,
        /// Smallest eigenvalue of C in Mandel form, MPa.
        eigenvalue: f64,
        constants: String,
    },
    /// A fibre direction is not a unit vector.
    #[error(
        "fibre[{tet}] has length {length}: it must be 1 within {tolerance:.0e}; divide it by its length"
    )]
    FibreNotUnit {
        /// The tet (0 for a uniform tissue).
        tet: usize,
        length: f64,
        tolerance: f64,
    },
    /// A node was given two contradictory kinds.
    #[error("node {node} is both {first} and {second}: a node has one kind")]
    NodeOfTwoKinds { node: usize, first: String, second: String },
    /// A segment has sliding nodes and no contact surface, or the reverse, or nothing attached to it.
    #[error("segment \"{segment}\" {problem}")]
    Segment { segment: String, problem: String },
    /// Nodes that may touch a surface do not match it.
    #[error("touching pair {pair} {problem}")]
    TouchingPair { pair: usize, problem: String },
    /// A plan does not fit the boundary.
    #[error("plan for segment \"{segment}\": {problem}")]
    Plan { segment: String, problem: String },
    /// Part of the body can move without deforming.
    #[error(
        "{what} is not constrained: {modes} ({nodes} nodes, for example node {node}); fix or join at least three of its nodes that are not in line, or remove it"
    )]
    Unconstrained { what: String, modes: String, nodes: usize, node: usize },
    /// A contact surface is not usable.
    #[error("contact surface of segment \"{segment}\" {problem}")]
    ContactSurface { segment: String, problem: String },
    /// The contact solver ran out of steps, or made no progress.
    #[error(
        "contact did not converge: after {iterations} steps nodes {nodes:?} are off their surfaces or out of balance (largest gap {gap:.3e} mm, largest imbalance {unbalanced:.3e} mm); smooth the contact surface there, refine the tissue, or check that bones do not pass through each other"
    )]
    ContactNotConverged {
        iterations: usize,
        /// The nodes that are furthest from a solution (at most ten).
        nodes: Vec<usize>,
        gap: f64,
        /// Largest distance, mm, by which the remaining tangential force would move a node on its own.
        unbalanced: f64,
    },
    /// The factorisation met a pivot that is not positive, or the system is singular to working precision.
    #[error(
        "the stiffness matrix is not positive definite to working precision at node {node}: {detail}"
    )]
    NotPositiveDefinite { node: usize, detail: String },
    /// An iterative method stopped before its estimated error was small enough.
    #[error("{method} did not converge: after {iterations} iterations {shortfall}; {advice}")]
    NotConverged {
        method: &'static str,
        iterations: usize,
        shortfall: Shortfall,
        advice: &'static str,
    },
    /// The computation does not fit in memory.
    #[error("{what} needs about {needed_mb} MB, {}: {advice}", .limit_mb.map_or("which the system refuses".into(), |mb| format!("but {mb} MB are allowed")))]
    OutOfMemory {
        what: &'static str,
        needed_mb: usize,
        /// The limit that the caller set, MB; none if the system refused.
        limit_mb: Option<usize>,
        advice: &'static str,
    },
    /// A forked process could not start any threads.
    #[error(
        "no threads could be started ({reason}): allow this process more threads, or set RAYON_NUM_THREADS to fewer"
    )]
    NoThreads { reason: String },
    /// Fewer points than a registration needs.
    #[error("{what} needs at least {needed} {shape}, but there are {found}")]
    TooFewPoints { what: &'static str, found: usize, needed: usize, shape: &'static str },
    /// Two points of a registration coincide.
    #[error(
        "{what} {first} and {second} coincide: {distance:.3e} mm apart; remove one of them or place it again"
    )]
    CoincidentPoints { what: &'static str, first: usize, second: usize, distance: f64 },
    /// The points of a registration do not span the space that it needs.
    #[error(
        "{what} lie in one {shape}: {thickness:.3e} mm across for an extent of {size:.3e} mm, of which more than {limit:.0e} is needed; add a point away from it"
    )]
    FlatPoints { what: &'static str, shape: &'static str, thickness: f64, size: f64, limit: f64 },
    /// The points of a registration do not determine its motion.
    #[error("{what} is not determined: {reason}")]
    NotDetermined { what: &'static str, reason: String },
    /// A matrix is not a rigid motion.
    #[error("{what}: {problem}")]
    NotRigid { what: String, problem: String, kind: ErrorKind },
    /// Iterative closest points were still moving at the last step.
    #[error(
        "icp did not converge: in step {iterations} the points still moved by {motion:.3e} mm ({tolerance:.3e} mm or less is needed), rms distance {:.4e} mm after {:.4e} mm at first; start closer (initial), exclude points without a partner (trim, max_distance), or allow more steps", .history.last().copied().unwrap_or(f64::NAN), .history.first().copied().unwrap_or(f64::NAN)
    )]
    IcpNotConverged {
        iterations: usize,
        motion: f64,
        tolerance: f64,
        /// Root mean square distance before the first step and after each, mm.
        history: Vec<f64>,
    },
    /// The caller asked to stop.
    #[error("interrupted by the caller")]
    Interrupted,
    /// A choice that exists does not go with another one.
    #[error("{what} is \"{found}\": {with} needs {needed}")]
    NotTogether {
        what: &'static str,
        found: String,
        with: &'static str,
        needed: &'static str,
        kind: ErrorKind,
    },
    /// A result is too large for a number.
    #[error("{what} is not finite: {why}")]
    Overflow { what: &'static str, why: &'static str },
    /// A name is not one of those known.
    #[error("{what} \"{found}\" is unknown: use one of {known}")]
    UnknownName { what: &'static str, found: String, known: String, kind: ErrorKind },
}

/// A value as shown in an error: without hundreds of digits.
fn shown(value: f64) -> String {
    let size = value.abs();
    if value.is_finite() && size != 0.0 && !(1e-5..1e9).contains(&size) {
        format!("{value:e}")
    } else {
        value.to_string()
    }
}

/// Result of a fallible operation of this crate.
pub type Result<T> = std::result::Result<T, MtmError>;
