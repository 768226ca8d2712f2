//! Elimination order of the nodes: nested dissection if METIS is built in, postordering, and keeping a chosen
//! set of nodes last. The only file that refers to METIS.

use crate::algebra::blocks::BlockMatrix;
#[cfg(feature = "metis")]
use crate::error::MtmError;
use crate::error::Result;

/// Node graph in compressed rows, without loops.
#[derive(Debug, Clone)]
pub struct NodeGraph {
    /// First neighbour of each node; one more entry than nodes.
    pub start: Vec<i32>,
    /// Neighbours.
    pub neighbours: Vec<i32>,
}

impl NodeGraph {
    /// The graph of the rows of `matrix` for which `keep` holds, and the row that each of its nodes represents.
    pub fn of_rows(matrix: &BlockMatrix, keep: impl Fn(usize) -> bool) -> (Self, Vec<u32>) {
        let n = matrix.n_rows();
        let rows: Vec<u32> = (0..n).filter(|&j| keep(j)).map(|j| j as u32).collect();
        let mut local = vec![-1_i32; n];
        for (i, &j) in rows.iter().enumerate() {
            local[j as usize] = i as i32;
        }
        let (mut start, mut neighbours) = (vec![0], Vec::new());
        for &j in &rows {
            let (columns, _) = matrix.row(j as usize);
            neighbours.extend(
                columns.iter().filter(|&&k| k != j).map(|&k| local[k as usize]).filter(|&k| k >= 0),
            );
            start.push(neighbours.len() as i32);
        }
        (Self { start, neighbours }, rows)
    }

    /// Number of nodes.
    pub fn n_nodes(&self) -> usize {
        self.start.len() - 1
    }
}

/// The two functions of METIS that are called (`metis/libmetis/metis.h`), with 32-bit indices.
#[cfg(feature = "metis")]
mod metis {
    use std::ffi::c_int;

    /// Length of the options.
    pub const N_OPTIONS: usize = 40;
    /// Index of the random seed among the options.
    pub const SEED: usize = 9;
    /// Index of the option for the first index, 0 or 1.
    pub const NUMBERING: usize = 18;
    /// Return value of a successful call.
    pub const OK: c_int = 1;

    #[allow(unsafe_code)]
    unsafe extern "C" {
        pub fn METIS_SetDefaultOptions(options: *mut i32) -> c_int;
        pub fn METIS_NodeND(
            count: *mut i32,
            start: *mut i32,
            neighbours: *mut i32,
            weights: *mut i32,
            options: *mut i32,
            order: *mut i32,
            position: *mut i32,
        ) -> c_int;
    }
}

/// The right to call METIS, which only one thread of a process has at a time.
///
/// METIS uses C's rand(), seeded at each call: two simultaneous calls would share the sequence, and the order
/// would depend on timing. A process that was forked while another thread of its parent held the right takes it
/// over, since that thread does not exist in this process.
#[cfg(feature = "metis")]
struct Turn;

#[cfg(feature = "metis")]
impl Turn {
    /// The process that holds it; 0: none.
    const NOBODY: u32 = 0;

    fn holder() -> &'static std::sync::atomic::AtomicU32 {
        static HOLDER: std::sync::atomic::AtomicU32 =
            std::sync::atomic::AtomicU32::new(Turn::NOBODY);
        &HOLDER
    }

    fn wait() -> Self {
        use std::sync::atomic::Ordering::{Acquire, Relaxed};
        let here = std::process::id();
        loop {
            let holder = Self::holder().load(Relaxed);
            if holder != here
                && Self::holder().compare_exchange(holder, here, Acquire, Relaxed).is_ok()
            {
                return Self;
            }
            std::thread::sleep(std::time::Duration::from_micros(200));
        }
    }
}

#[cfg(feature = "metis")]
impl Drop for Turn {
    fn drop(&mut self) {
        Self::holder().store(Self::NOBODY, std::sync::atomic::Ordering::Release);
    }
}

/// Nested-dissection order (position → node) by METIS (Karypis & Kumar 1998), the same on every call.
#[cfg(feature = "metis")]
pub fn nested_dissection(graph: &NodeGraph) -> Result<Option<Vec<u32>>> {
    const SEED: i32 = 1;

    let n = graph.n_nodes();
    if graph.neighbours.is_empty() {
        return Ok(Some((0..n as u32).collect()));
    }
    let mut count = n as i32;
    let (mut start, mut neighbours) = (graph.start.clone(), graph.neighbours.clone());
    let mut options = [0_i32; metis::N_OPTIONS];
    let (mut order, mut position) = (vec![0_i32; n], vec![0_i32; n]);
    let _turn = Turn::wait();
    // SAFETY: every pointer is to a live, exclusively borrowed buffer of the length METIS documents:
    // start n+1, neighbours start[n], options METIS_NOPTIONS, order and position n; null vertex weights
    // are allowed. METIS keeps none of them.
    #[allow(unsafe_code)]
    let status = unsafe {
        metis::METIS_SetDefaultOptions(options.as_mut_ptr());
        options[metis::SEED] = SEED;
        options[metis::NUMBERING] = 0;
        metis::METIS_NodeND(
            &mut count,
            start.as_mut_ptr(),
            neighbours.as_mut_ptr(),
            std::ptr::null_mut(),
            options.as_mut_ptr(),
            order.as_mut_ptr(),
            position.as_mut_ptr(),
        )
    };
    if status != metis::OK {
        // The graph is well formed, so the only possible failure is lack of memory.
        let advice = "use method=\"pcg\", which needs no elimination order";
        let bytes = 64 * neighbours.len();
        return Err(MtmError::out_of_memory("nested dissection", bytes, None, advice));
    }
    Ok(Some(order.iter().map(|&j| j as u32).collect()))
}

/// Without METIS there is no nested dissection; the caller uses minimum degree instead.
#[cfg(not(feature = "metis"))]
pub fn nested_dissection(_graph: &NodeGraph) -> Result<Option<Vec<u32>>> {
    Ok(None)
}

/// Postorder of a forest given by parents (`usize::MAX` for roots): children before parents, each subtree
/// contiguous, so that columns of one supernode become neighbours.
pub fn postorder(parents: &[usize]) -> Vec<u32> {
    let n = parents.len();
    let (mut first_child, mut sibling) = (vec![usize::MAX; n], vec![usize::MAX; n]);
    for j in (0..n).rev() {
        if parents[j] != usize::MAX {
            sibling[j] = first_child[parents[j]];
            first_child[parents[j]] = j;
        }
    }
    let (mut order, mut stack) = (Vec::with_capacity(n), Vec::new());
    for root in (0..n).filter(|&j| parents[j] == usize::MAX) {
        stack.push(root);
        while let Some(&top) = stack.last() {
            let child = first_child[top];
            if child == usize::MAX {
                order.push(top as u32);
                stack.pop();
            } else {
                first_child[top] = sibling[child];
                stack.push(child);
            }
        }
    }
    order
}

/// Position of each row in the order.
pub fn positions(order: &[u32]) -> Vec<u32> {
    let mut position = vec![0_u32; order.len()];
    for (p, &j) in order.iter().enumerate() {
        position[j as usize] = p as u32;
    }
    position
}

/// Elimination tree of the graph of `matrix` in the order `order` (position → row): the parent position
/// of each position, `usize::MAX` for roots (Liu 1986).
pub fn elimination_tree(matrix: &BlockMatrix, order: &[u32]) -> Vec<usize> {
    let (n, position) = (order.len(), positions(order));
    let (mut parent, mut ancestor) = (vec![usize::MAX; n], vec![usize::MAX; n]);
    for p in 0..n {
        for &k in matrix.row(order[p] as usize).0 {
            let mut i = position[k as usize] as usize;
            while i < p && ancestor[i] != p {
                let next = ancestor[i];
                ancestor[i] = p;
                if next == usize::MAX {
                    parent[i] = p;
                    break;
                }
                i = next;
            }
        }
    }
    parent
}
