//! Node kinds, bone segments and plans: which nodes are fixed, which move with bone, which slide on it.

use std::collections::HashMap;
use std::sync::Arc;

use crate::error::{ErrorKind, LARGEST_COORDINATE, MtmError, Result, check_coordinates};
use crate::geometry::motion::{RigidMotion, SurfaceMotion};
use crate::geometry::surface::Surface;
use crate::vector::{add, scaled};

/// Prescribed distance of sliding nodes from their contact surface, negative behind it, mm.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Gap {
    /// The same for every sliding node; 0 puts them on the surface.
    Uniform(f64),
    /// One per sliding node, in the order they were given.
    PerNode(Vec<f64>),
    /// The offset of each node from its closest point at rest, moved with the segment.
    Rest,
}

/// What happens when a node is given two kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Conflicts {
    /// Report an error that names the node.
    Refuse,
    /// Fixed takes precedence over joined, joined over sliding; the overridden kinds are counted.
    Resolve,
}

/// One bone segment and the tissue nodes that depend on it.
#[derive(Debug, Clone)]
pub struct Segment {
    /// Its name, as plans use it.
    pub name: String,
    /// Nodes that move with it.
    pub joined: Vec<u32>,
    /// Nodes that slide on its contact surface.
    pub sliding: Vec<u32>,
    /// The surface they slide on, at rest.
    pub contact: Option<Arc<Surface>>,
    /// Their prescribed distance from it.
    pub gap: Gap,
}

/// A surface that the nodes of a [`TouchingPair`] may not enter.
#[derive(Debug, Clone)]
pub enum Against {
    /// The tissue behind these triangles of the mesh's boundary, outward normals; they deform with it.
    Tissue(Vec<[u32; 3]>),
    /// Bone behind a surface at rest, with normals pointing out of the bone.
    Bone {
        /// The surface.
        surface: Arc<Surface>,
        /// The segment that it moves with; none for bone that does not move.
        segment: Option<String>,
    },
}

/// Nodes that may touch a surface other than that of a sliding node, and separate from it again: without
/// friction, and without force while separated.
#[derive(Debug, Clone)]
pub struct TouchingPair {
    /// The nodes.
    pub nodes: Vec<u32>,
    /// The surface that they may touch.
    pub against: Against,
}

/// Kinds of the nodes: every node not listed is free, and each node has one kind.
#[derive(Debug, Clone)]
pub struct Boundary {
    fixed: Vec<u32>,
    segments: Vec<Segment>,
    touching: Vec<TouchingPair>,
    /// Joined nodes in the order given by the caller: rows of a plan's displacements follow this order.
    given: Vec<Vec<u32>>,
    conflicts: usize,
    /// Joined mid-edge nodes, with the ends of their edges.
    inherited: HashMap<u32, [u32; 2]>,
    /// Nodes that some plans hold, ascending, and the segment that these are then joined to; fixed without one.
    liftable: (Vec<u32>, Option<usize>),
}

/// How a segment moves.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Motion {
    /// As a rigid body.
    Rigid(RigidMotion),
    /// Its joined nodes move by these displacements, mm, in the order they were given.
    Nodes(Vec<[f64; 3]>),
    /// As a surface whose vertices have new positions.
    Surface(Arc<SurfaceMotion>),
}

impl Motion {
    /// The rigid motion, if it is one.
    pub(crate) fn rigid(&self) -> Option<&RigidMotion> {
        match self {
            Self::Rigid(rigid) => Some(rigid),
            Self::Nodes(_) | Self::Surface(_) => None,
        }
    }

    /// Displacements of `points` that follow the segment, mm; none if only its joined nodes are known to move.
    pub(crate) fn displacements(&self, points: &[[f64; 3]]) -> Option<Vec<[f64; 3]>> {
        match self {
            Self::Rigid(rigid) => Some(points.iter().map(|&x| rigid.displacement(x)).collect()),
            Self::Surface(surface) => Some(surface.displacement(points)),
            Self::Nodes(_) => None,
        }
    }
}

/// A motion for each segment, by name.
pub type Plan = Vec<(String, Motion)>;

/// Kind of a node, with the index of its segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NodeKind {
    /// Moves according to the forces.
    Free,
    /// Does not move.
    Fixed,
    /// Moves with a segment.
    Joined(usize),
    /// Slides on the contact surface of a segment.
    Sliding(usize),
}

impl Boundary {
    /// The checked boundary.
    ///
    /// # Errors
    /// A node of two kinds (unless resolved), a node joined to two segments, segments with the same name, with
    /// nothing attached, or sliding without a contact surface, a wrong number of gaps, gaps that are not
    /// finite.
    pub fn new(fixed: Vec<u32>, segments: Vec<Segment>, conflicts: Conflicts) -> Result<Self> {
        let mut boundary = Self {
            fixed: unique(&fixed),
            given: segments.iter().map(|s| s.joined.clone()).collect(),
            segments,
            touching: Vec::new(),
            conflicts: 0,
            inherited: HashMap::new(),
            liftable: (Vec::new(), None),
        };
        boundary.check_segments()?;
        let fixed = boundary.fixed.iter();
        let mut taken: HashMap<u32, String> = fixed.map(|&node| (node, "fixed".into())).collect();
        let mut lost = 0;
        let mut claim = |nodes: &mut Vec<u32>, role: String| -> Result<Vec<usize>> {
            let (mut kept, mut rows) = (Vec::new(), Vec::new());
            for (row, &node) in nodes.iter().enumerate() {
                match taken.get(&node) {
                    None => {
                        taken.insert(node, role.clone());
                        kept.push(node);
                        rows.push(row);
                    }
                    Some(owner) if *owner == role => {}
                    Some(owner) => {
                        let rival = owner.starts_with("joined") && role.starts_with("joined");
                        if conflicts == Conflicts::Refuse || rival {
                            let (first, second) = (owner.clone(), role);
                            let node = node as usize;
                            return Err(MtmError::NodeOfTwoKinds { node, first, second });
                        }
                        lost += 1;
                    }
                }
            }
            *nodes = kept;
            Ok(rows)
        };
        for segment in &mut boundary.segments {
            let role = format!("joined to \"{}\"", segment.name);
            claim(&mut segment.joined, role)?;
        }
        for segment in &mut boundary.segments {
            let role = format!("sliding on \"{}\"", segment.name);
            let rows = claim(&mut segment.sliding, role)?;
            if let Gap::PerNode(values) = &mut segment.gap {
                *values = rows.iter().map(|&row| values[row]).collect();
            }
        }
        boundary.conflicts = lost;
        Ok(boundary)
    }

    /// The boundary with pairs that may touch.
    ///
    /// # Errors
    /// A pair without nodes or without triangles, or with a segment that is not part of the boundary.
    pub fn with_touching(mut self, pairs: Vec<TouchingPair>) -> Result<Self> {
        for (pair, TouchingPair { nodes, against }) in pairs.iter().enumerate() {
            let fail = |problem: String| Err(MtmError::TouchingPair { pair, problem });
            if nodes.is_empty() {
                return fail("has no nodes: add some or remove it".into());
            }
            match against {
                Against::Tissue(triangles) if triangles.is_empty() => {
                    return fail("has no triangles: add some or remove it".into());
                }
                Against::Bone { segment: Some(name), .. }
                    if !self.segments.iter().any(|s| s.name == *name) =>
                {
                    return fail(format!(
                        "faces the bone of segment \"{name}\", which has neither joined nor sliding nodes; \
                         give none for bone that does not move"
                    ));
                }
                _ => {}
            }
        }
        self.touching = pairs;
        Ok(self)
    }

    /// The boundary with nodes that plans hold or free ([`holding`](Self::holding)): joined to `segment` while they
    /// are held, or fixed if there is none. Those that are so already are held.
    ///
    /// # Errors
    /// A segment that is not part of the boundary, a node of another kind.
    pub fn with_liftable(mut self, nodes: &[u32], segment: Option<&str>) -> Result<Self> {
        let place = |name| self.segments.iter().position(|s| s.name == name);
        let joined_to = segment.map(|name: &str| {
            let problem = "cannot hold liftable nodes: the boundary has no such segment".into();
            place(name).ok_or(MtmError::Segment { segment: name.to_owned(), problem })
        });
        let mut sorted = unique(nodes);
        sorted.sort_unstable();
        self.liftable = (sorted, joined_to.transpose()?);
        let (nodes, own) = &self.liftable;
        let mut others = vec![("fixed", own.map(|_| &self.fixed))];
        for (s, segment) in self.segments.iter().enumerate() {
            others.push(("joined", (*own != Some(s)).then_some(&segment.joined)));
            others.push(("sliding", Some(&segment.sliding)));
        }
        for (kind, others) in others {
            let both = others.and_then(|o| o.iter().find(|j| nodes.binary_search(j).is_ok()));
            if let Some(&node) = both {
                let (node, first, second) = (node as usize, kind.into(), "liftable".into());
                return Err(MtmError::NodeOfTwoKinds { node, first, second });
            }
        }
        Ok(self)
    }

    /// The boundary that holds `nodes` of those that plans hold or free, and no others of them.
    ///
    /// # Errors
    /// A node that is not one of them.
    pub fn holding(&self, nodes: &[u32]) -> Result<Self> {
        let (liftable, own) = &self.liftable;
        let is_liftable = |node: &u32| liftable.binary_search(node).is_ok();
        if let Some(node) = nodes.iter().find(|node| !is_liftable(node)) {
            let needed = "nodes that its boundary was given as liftable";
            let held = ("held node", &node.to_string()[..]);
            return Err(ErrorKind::Boundary.not_together(held, "a solver for other plans", needed));
        }
        let mut out = self.clone();
        let (held, given) = match *own {
            Some(s) => (&mut out.segments[s].joined, Some(s)),
            None => (&mut out.fixed, None),
        };
        held.retain(|node| !is_liftable(node));
        held.extend(unique(nodes));
        if let Some(s) = given {
            out.given[s].clone_from(&out.segments[s].joined);
        }
        Ok(out)
    }

    /// The nodes that plans hold or free, ascending, and the places among them of those that are held.
    pub fn liftable(&self) -> (&[u32], Vec<usize>) {
        let (nodes, own) = &self.liftable;
        let held = own.map_or(&self.fixed, |s| &self.segments[s].joined);
        let mut places: Vec<usize> =
            held.iter().filter_map(|node| nodes.binary_search(node).ok()).collect();
        places.sort_unstable();
        (nodes, places)
    }

    /// Kind of the nodes that plans hold or free, while they are held.
    pub(crate) fn liftable_kind(&self) -> NodeKind {
        self.liftable.1.map_or(NodeKind::Fixed, NodeKind::Joined)
    }

    /// The boundary with mid-edge nodes: node `n_corners + i` lies between `edges[i]`.
    ///
    /// A node is fixed or joined if both ends of its edge are (to the same segment), slides if both ends slide
    /// on the same segment and its edge lies on the surface of the body, and is free otherwise. (An edge
    /// through the body may end at a sliding node and lead away from its contact surface.) A prescribed gap is
    /// the mean of those of the ends.
    ///
    /// # Errors
    /// A node index of `n_corners` or more.
    pub fn with_mid_edges(
        &self,
        n_corners: usize,
        edges: &[[u32; 2]],
        on_surface: impl Fn([u32; 2]) -> bool,
    ) -> Result<Self> {
        let kinds = self.kinds(n_corners)?;
        let mut out = self.clone();
        let mut gap_of: HashMap<u32, f64> = HashMap::new();
        for segment in &self.segments {
            if let Gap::PerNode(values) = &segment.gap {
                gap_of.extend(segment.sliding.iter().copied().zip(values.iter().copied()));
            }
        }
        for (i, &[a, b]) in edges.iter().enumerate() {
            let node = (n_corners + i) as u32;
            if kinds[a as usize] != kinds[b as usize] {
                continue;
            }
            match kinds[a as usize] {
                NodeKind::Fixed => out.fixed.push(node),
                NodeKind::Joined(s) => {
                    out.segments[s].joined.push(node);
                    out.inherited.insert(node, [a, b]);
                }
                NodeKind::Sliding(s) if on_surface([a, b]) => {
                    out.segments[s].sliding.push(node);
                    if let Gap::PerNode(values) = &mut out.segments[s].gap {
                        values.push(0.5 * (gap_of[&a] + gap_of[&b]));
                    }
                }
                NodeKind::Sliding(_) | NodeKind::Free => {}
            }
        }
        Ok(out)
    }

    fn check_segments(&self) -> Result<()> {
        for (i, segment) in self.segments.iter().enumerate() {
            let fail =
                |problem: String| Err(MtmError::Segment { segment: segment.name.clone(), problem });
            if self.segments[..i].iter().any(|s| s.name == segment.name) {
                return fail("is named twice".into());
            }
            if segment.joined.is_empty() && segment.sliding.is_empty() {
                return fail("has neither joined nor sliding nodes: add some or remove it".into());
            }
            if !segment.sliding.is_empty() && segment.contact.is_none() {
                return fail(format!(
                    "has {} sliding nodes but no contact surface: pass contact={{\"{}\": surface}}",
                    segment.sliding.len(),
                    segment.name
                ));
            }
            match &segment.gap {
                Gap::Uniform(value) if !is_gap(*value) => {
                    return fail(format!(
                        "has a gap of {value}: it must be finite, -1e6 to 1e6 mm"
                    ));
                }
                Gap::PerNode(values) if values.len() != segment.sliding.len() => {
                    return fail(format!(
                        "has {} gaps for {} sliding nodes: give one value, or one per sliding node",
                        values.len(),
                        segment.sliding.len()
                    ));
                }
                Gap::PerNode(values) => {
                    if let Some(index) = values.iter().position(|&v| !is_gap(v)) {
                        return fail(format!(
                            "has gap[{index}] = {}: it must be finite, -1e6 to 1e6 mm",
                            values[index]
                        ));
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Nodes that do not move.
    pub fn fixed(&self) -> &[u32] {
        &self.fixed
    }

    /// The segments, in the order given.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// Pairs that may touch, in the order given.
    pub fn touching(&self) -> &[TouchingPair] {
        &self.touching
    }

    /// Number of nodes that were given two kinds, one of which was dropped.
    pub fn conflicts(&self) -> usize {
        self.conflicts
    }

    /// Whether any node slides.
    pub fn has_sliding(&self) -> bool {
        self.segments.iter().any(|s| !s.sliding.is_empty())
    }

    /// Kind of each of `n` nodes.
    ///
    /// # Errors
    /// A node index of `n` or more.
    pub fn kinds(&self, n: usize) -> Result<Vec<NodeKind>> {
        let mut kinds = vec![NodeKind::Free; n];
        let mut set = |what: String, nodes: &[u32], kind: NodeKind| -> Result<()> {
            for (row, &node) in nodes.iter().enumerate() {
                let Some(slot) = kinds.get_mut(node as usize) else {
                    return Err(ErrorKind::Boundary.no_such((what, row), "node", node, n));
                };
                *slot = kind;
            }
            Ok(())
        };
        set("liftable".into(), &self.liftable.0, NodeKind::Free)?;
        set("fixed".into(), &self.fixed, NodeKind::Fixed)?;
        for (s, segment) in self.segments.iter().enumerate() {
            set(format!("joined[\"{}\"]", segment.name), &segment.joined, NodeKind::Joined(s))?;
            set(format!("sliding[\"{}\"]", segment.name), &segment.sliding, NodeKind::Sliding(s))?;
        }
        Ok(kinds)
    }

    /// The motions of `plan` in the order of the segments.
    ///
    /// # Errors
    /// A segment that the plan lacks or lists twice, a name that is not a segment, displacements of the wrong
    /// number or not finite, displacements for a segment with sliding nodes.
    pub fn motions<'a>(&self, plan: &'a Plan) -> Result<Vec<&'a Motion>> {
        let names: Vec<&str> = self.segments.iter().map(|s| s.name.as_str()).collect();
        let motions = matched(plan, &names)?;
        self.segments
            .iter()
            .zip(&self.given)
            .zip(motions)
            .map(|((segment, given), motion)| {
                if let Motion::Nodes(rows) = motion {
                    if rows.len() != given.len() {
                        let problem = format!(
                            "{} displacements for its {} joined nodes",
                            rows.len(),
                            given.len()
                        );
                        return Err(misplanned(&segment.name, problem));
                    }
                    let what = format!("plan[\"{}\"]", segment.name);
                    check_coordinates(&what, rows, ErrorKind::Boundary)?;
                    let faced = |pair: &TouchingPair| {
                        matches!(&pair.against, Against::Bone { segment: Some(s), .. } if *s == segment.name)
                    };
                    if !segment.sliding.is_empty() || self.touching.iter().any(faced) {
                        return Err(misplanned(
                            &segment.name,
                            "displacements of joined nodes do not say how its contact surface moves; \
                             give a rigid 4×4 matrix or a SurfaceMotion",
                        ));
                    }
                }
                Ok(motion)
            })
            .collect()
    }

    /// Joined nodes of segment `s` with their displacements under `motion`, mm.
    ///
    /// # Errors
    /// A node listed twice with different displacements.
    pub fn joined_displacements(
        &self,
        s: usize,
        motion: &Motion,
        nodes: &[[f64; 3]],
    ) -> Result<Vec<(u32, [f64; 3])>> {
        let segment = &self.segments[s];
        let Motion::Nodes(rows) = motion else {
            let places: Vec<[f64; 3]> = segment.joined.iter().map(|&j| nodes[j as usize]).collect();
            let moved = motion.displacements(&places).unwrap_or_default();
            return Ok(segment.joined.iter().copied().zip(moved).collect());
        };
        let mut seen: HashMap<u32, [f64; 3]> = HashMap::new();
        for (row, (&node, &u)) in self.given[s].iter().zip(rows).enumerate() {
            if let Some(before) = seen.insert(node, u)
                && before != u
            {
                let problem =
                    format!("row {row} moves node {node} by {u:?}, an earlier row by {before:?}");
                return Err(misplanned(&segment.name, problem));
            }
        }
        let own = |j: &u32| match self.inherited.get(j) {
            Some([a, b]) => (*j, scaled(add(seen[a], seen[b]), 0.5)),
            None => (*j, seen[j]),
        };
        Ok(segment.joined.iter().map(own).collect())
    }
}

/// The motion of each of `segments` in `plan`, in their order.
///
/// # Errors
/// A segment that the plan lacks or lists twice, a name that is not a segment.
pub(crate) fn matched<'a>(plan: &'a Plan, segments: &[&str]) -> Result<Vec<&'a Motion>> {
    for (i, (name, _)) in plan.iter().enumerate() {
        if !segments.contains(&name.as_str()) {
            let known: Vec<String> = segments.iter().map(|s| format!("\"{s}\"")).collect();
            let known = known.join(", ");
            return Err(misplanned(name, format!("no such segment; the boundary has {known}")));
        }
        if plan[..i].iter().any(|(other, _)| other == name) {
            return Err(misplanned(name, "it is named twice"));
        }
    }
    segments
        .iter()
        .map(|&segment| match plan.iter().find(|(name, _)| name == segment) {
            Some((_, Motion::Rigid(rigid))) if is_far(rigid) => Err(misplanned(
                segment,
                format!(
                    "its translation {:?} mm is out of range: allowed is -1e7 to 1e7 mm; check the \
                     units",
                    [0, 1, 2].map(|i| rigid.matrix()[i][3])
                ),
            )),
            Some((_, motion)) => Ok(motion),
            None => Err(misplanned(
                segment,
                "it is missing; a plan names every segment (identity matrix: no motion)",
            )),
        })
        .collect()
}

/// The error for a plan that does not fit the boundary.
pub(crate) fn misplanned(segment: &str, problem: impl Into<String>) -> MtmError {
    MtmError::Plan { segment: segment.to_owned(), problem: problem.into() }
}

/// Whether a gap, mm, is within the range that contact can maintain.
fn is_gap(value: f64) -> bool {
    value.abs() <= LARGEST_COORDINATE
}

/// Whether a motion leads outside the range of coordinates, for any centre of rotation.
fn is_far(rigid: &RigidMotion) -> bool {
    rigid.matrix().iter().any(|row| row[3].abs() > 10.0 * LARGEST_COORDINATE)
}

/// `nodes` without repetitions, first occurrences kept in order.
fn unique(nodes: &[u32]) -> Vec<u32> {
    let mut seen = std::collections::HashSet::new();
    nodes.iter().copied().filter(|&j| seen.insert(j)).collect()
}
