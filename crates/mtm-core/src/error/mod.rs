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
/// outcome (no convergence, a mechanism) is reported by the solver with the figures reached.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum MtmError {
    /// An array has no entries.
    #[error("{what} is empty: at least one entry is needed")]
    Empty {
        /// The array.
        what: &'static str,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// Two arrays that belong together have different lengths.
    #[error("{what} has {found} entries where {expected} are needed ({why})")]
    Length {
        /// The array.
        what: String,
        /// Its length.
        found: usize,
        /// The required length.
        expected: usize,
        /// What determines that length.
        why: &'static str,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// A value is NaN or infinite.
    #[error("{what}[{index}] is {value}: every value must be finite")]
    NotFinite {
        /// The array.
        what: String,
        /// Row of the offending value.
        index: usize,
        /// The value.
        value: f64,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// A value lies outside the allowed range.
    #[error("{what}[{index}] is {}: allowed is {allowed}", shown(*.value))]
    OutOfRange {
        /// The array or parameter.
        what: String,
        /// Row of the offending value (0 for a scalar).
        index: usize,
        /// The value.
        value: f64,
        /// The allowed range, in words.
        allowed: &'static str,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// An index points past the end of what it indexes.
    #[error("{what}[{row}] refers to {item} {index}, but there are {count} (allowed 0 to {}); is the file numbered from 1?", .count.saturating_sub(1))]
    IndexOutOfRange {
        /// The index array.
        what: String,
        /// Row of the offending index.
        row: usize,
        /// What is indexed.
        item: &'static str,
        /// The index.
        index: usize,
        /// How many items there are.
        count: usize,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// A tet names the same node twice.
    #[error(
        "tet {tet} names node {node} twice: nodes {nodes:?}; remove the tet or fix its connectivity"
    )]
    DuplicateNode {
        /// The tet.
        tet: usize,
        /// The repeated node.
        node: u32,
        /// Its four nodes.
        nodes: [u32; 4],
    },
    /// A tet has negative volume.
    #[error(
        "tet {tet} is inverted: volume {volume:.6e}; swap two of its nodes {nodes:?} ({count} inverted tets in all)"
    )]
    InvertedTet {
        /// The first inverted tet.
        tet: usize,
        /// Its signed volume.
        volume: f64,
        /// Its four nodes.
        nodes: [u32; 4],
        /// How many tets are inverted.
        count: usize,
    },
    /// A tet has practically no volume.
    #[error(
        "tet {tet} is degenerate: volume {volume:.6e} for a longest edge of {edge:.6e}, below {limit:.1e} of its cube; remove or re-mesh it (nodes {nodes:?})"
    )]
    DegenerateTet {
        /// The tet.
        tet: usize,
        /// Its signed volume.
        volume: f64,
        /// Its longest edge.
        edge: f64,
        /// Relative volume below which a tet counts as degenerate.
        limit: f64,
        /// Its four nodes.
        nodes: [u32; 4],
    },
    /// Two tets have the same four nodes.
    #[error(
        "tets {first} and {second} have the same four nodes {nodes:?}: remove one, or its stiffness counts twice"
    )]
    DuplicateTet {
        /// First of the pair.
        first: usize,
        /// Second of the pair.
        second: usize,
        /// Their nodes, sorted.
        nodes: [u32; 4],
    },
    /// A node belongs to no tet.
    #[error(
        "node {node} belongs to no tet ({count} such nodes): remove unused nodes before building the mesh"
    )]
    UnusedNode {
        /// The first such node.
        node: usize,
        /// How many there are.
        count: usize,
    },
    /// A triangle has no area.
    #[error("triangle {triangle} of {what} is degenerate: area {area:.3e}, vertices {vertices:?}")]
    DegenerateTriangle {
        /// The surface.
        what: String,
        /// The triangle.
        triangle: usize,
        /// Its area.
        area: f64,
        /// Its vertices.
        vertices: [u32; 3],
    },
    /// A stiffness matrix is not symmetric.
    #[error(
        "stiffness of tet {tet} is not symmetric: C[{row}][{column}] = {upper:.6e} but C[{column}][{row}] = {lower:.6e}"
    )]
    AsymmetricStiffness {
        /// The tet (0 for a uniform tissue).
        tet: usize,
        /// Row of the entry.
        row: usize,
        /// Column of the entry.
        column: usize,
        /// Entry above the diagonal.
        upper: f64,
        /// Entry below the diagonal.
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
        /// The constants that define it.
        constants: String,
    },
    /// A fibre direction is not a unit vector.
    #[error(
        "fibre[{tet}] has length {length}: it must be 1 within {tolerance:.0e}; divide it by its length"
    )]
    FibreNotUnit {
        /// The tet (0 for a uniform tissue).
        tet: usize,
        /// Its length.
        length: f64,
        /// Allowed deviation.
        tolerance: f64,
    },
    /// A node was given two contradictory kinds.
    #[error("node {node} is both {first} and {second}: a node has one kind")]
    NodeOfTwoKinds {
        /// The node.
        node: usize,
        /// First role.
        first: String,
        /// Second role.
        second: String,
    },
    /// A segment has sliding nodes and no contact surface, or the reverse, or nothing attached to it.
    #[error("segment \"{segment}\" {problem}")]
    Segment {
        /// The segment's name.
        segment: String,
        /// What is wrong with it, and the fix.
        problem: String,
    },
    /// Nodes that may touch a surface do not match it.
    #[error("touching pair {pair} {problem}")]
    TouchingPair {
        /// Index of the pair.
        pair: usize,
        /// What is wrong with it, and the fix.
        problem: String,
    },
    /// A plan does not fit the boundary.
    #[error("plan for segment \"{segment}\": {problem}")]
    Plan {
        /// The segment's name.
        segment: String,
        /// What is wrong, and the fix.
        problem: String,
    },
    /// Part of the body can move without deforming.
    #[error(
        "{what} is not constrained: {modes} ({nodes} nodes, for example node {node}); fix or join at least three of its nodes that are not in line, or remove it"
    )]
    Unconstrained {
        /// The part of the body, in words.
        what: String,
        /// The free rigid modes, in words.
        modes: String,
        /// How many nodes it has.
        nodes: usize,
        /// One of them.
        node: usize,
    },
    /// A contact surface is not usable.
    #[error("contact surface of segment \"{segment}\" {problem}")]
    ContactSurface {
        /// The segment's name.
        segment: String,
        /// What is wrong, where, and the fix.
        problem: String,
    },
    /// The contact solver ran out of steps, or made no progress.
    #[error(
        "contact did not converge: after {iterations} steps nodes {nodes:?} are off their surfaces or out of balance (largest gap {gap:.3e} mm, largest imbalance {unbalanced:.3e} mm); smooth the contact surface there, refine the tissue, or check that bones do not pass through each other"
    )]
    ContactNotConverged {
        /// Steps done.
        iterations: usize,
        /// The nodes that are furthest from a solution (at most ten).
        nodes: Vec<usize>,
        /// Largest gap reached, mm.
        gap: f64,
        /// Largest distance, mm, by which the remaining tangential force would move a node on its own.
        unbalanced: f64,
    },
    /// The factorisation met a pivot that is not positive, or the system is singular to working precision.
    #[error(
        "the stiffness matrix is not positive definite to working precision at node {node}: {detail}"
    )]
    NotPositiveDefinite {
        /// Node of the failing pivot.
        node: usize,
        /// What was observed.
        detail: String,
    },
    /// An iterative method stopped before its estimated error was small enough.
    #[error("{method} did not converge: after {iterations} iterations {shortfall}; {advice}")]
    NotConverged {
        /// The method.
        method: &'static str,
        /// Iterations done.
        iterations: usize,
        /// The condition that was not met.
        shortfall: Shortfall,
        /// What to try.
        advice: &'static str,
    },
    /// The computation does not fit in memory.
    #[error("{what} needs about {needed_mb} MB, {}: {advice}", .limit_mb.map_or("which the system refuses".into(), |mb| format!("but {mb} MB are allowed")))]
    OutOfMemory {
        /// The step.
        what: &'static str,
        /// Memory required, MB.
        needed_mb: usize,
        /// The limit that the caller set, MB; none if the system refused.
        limit_mb: Option<usize>,
        /// What to try.
        advice: &'static str,
    },
    /// A forked process could not start any threads.
    #[error(
        "no threads could be started ({reason}): allow this process more threads, or set RAYON_NUM_THREADS to fewer"
    )]
    NoThreads {
        /// The error reported by the system.
        reason: String,
    },
    /// Fewer points than a registration needs.
    #[error("{what} needs at least {needed} {shape}, but there are {found}")]
    TooFewPoints {
        /// What needs them.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many are needed.
        needed: usize,
        /// What the points must be, in words.
        shape: &'static str,
    },
    /// Two points of a registration coincide.
    #[error(
        "{what} {first} and {second} coincide: {distance:.3e} mm apart; remove one of them or place it again"
    )]
    CoincidentPoints {
        /// The points.
        what: &'static str,
        /// First of the pair.
        first: usize,
        /// Second of the pair.
        second: usize,
        /// Their distance, mm.
        distance: f64,
    },
    /// The points of a registration do not span the space that it needs.
    #[error(
        "{what} lie in one {shape}: {thickness:.3e} mm across for an extent of {size:.3e} mm, of which more than {limit:.0e} is needed; add a point away from it"
    )]
    FlatPoints {
        /// The points.
        what: &'static str,
        /// "plane" or "line".
        shape: &'static str,
        /// Their extent across it, mm.
        thickness: f64,
        /// Their longest extent, mm.
        size: f64,
        /// Allowed ratio of both.
        limit: f64,
    },
    /// The points of a registration do not determine its motion.
    #[error("{what} is not determined: {reason}")]
    NotDetermined {
        /// What is sought.
        what: &'static str,
        /// Why, and what to do.
        reason: String,
    },
    /// A matrix is not a rigid motion.
    #[error("{what}: {problem}")]
    NotRigid {
        /// The matrix.
        what: String,
        /// What is wrong with it, and the fix.
        problem: String,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// Iterative closest points were still moving at the last step.
    #[error(
        "icp did not converge: in step {iterations} the points still moved by {motion:.3e} mm ({tolerance:.3e} mm or less is needed), rms distance {:.4e} mm after {:.4e} mm at first; start closer (initial), exclude points without a partner (trim, max_distance), or allow more steps", .history.last().copied().unwrap_or(f64::NAN), .history.first().copied().unwrap_or(f64::NAN)
    )]
    IcpNotConverged {
        /// Steps done.
        iterations: usize,
        /// Largest motion of a point in the last step, mm.
        motion: f64,
        /// Motion below which the points count as converged, mm.
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
        /// The choice.
        what: &'static str,
        /// Its value.
        found: String,
        /// What it does not go with.
        with: &'static str,
        /// The values that go with it.
        needed: &'static str,
        /// The family of the error.
        kind: ErrorKind,
    },
    /// A result is too large for a number.
    #[error("{what} is not finite: {why}")]
    Overflow {
        /// The result.
        what: &'static str,
        /// What makes it so large.
        why: &'static str,
    },
    /// A name is not one of those known.
    #[error("{what} \"{found}\" is unknown: use one of {known}")]
    UnknownName {
        /// What is named.
        what: &'static str,
        /// The name given.
        found: String,
        /// The names that exist.
        known: &'static str,
        /// The family of the error.
        kind: ErrorKind,
    },
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
