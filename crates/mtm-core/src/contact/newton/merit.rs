//! The merit of a state, and steps shortened until they decrease it: the augmented Lagrangian
//! E − Σ λ φ + ½ Σ ρ φ² (Rockafellar 1973); for inequalities the terms of nodes in the air are −λ²/2ρ.

use crate::algebra::line_search::{Descent, first_of_halves};
use crate::contact::Response;
use crate::contact::newton::problem::{
    BALANCE_SHARE, ContactIterate, ContactProblem, along, farthest,
};
use crate::contact::seat::LocalShape;
use crate::vector::{between, norm, sub};

/// Initial penalty of the merit function over the own stiffness of each node.
pub(super) const FIRST_PENALTY: f64 = 10.0;
/// Largest penalty over the own stiffness: above it, steps would only follow the surface.
const MOST_PENALTY: f64 = 1e4;
/// How much all other terms may increase the merit, as a share of the decrease due to closing gaps.
const CLOSING_SHARE: f64 = 0.5;
/// Share of its largest gap that a step may leave if the gap exceeds the reach of the surfaces.
const STEADY_GAP: f64 = 0.6;
/// Shortest step over the full one.
const SHORTEST: f64 = 1.0 / 64.0;
/// Rounding error of the merit over the work of all contact forces along the step.
const MERIT_ROUNDING: f64 = 1e-9;

/// A step of the nodes with its contact forces, before the line search.
struct Way<'a> {
    state: &'a ContactIterate,
    /// Which nodes are held during the step.
    active: &'a [bool],
    /// Force on each node at its end, N.
    forces: Vec<f64>,
    /// Displacement of each node over it, mm.
    ways: Vec<[f64; 3]>,
}

impl ContactProblem<'_> {
    /// The state at the end of the step to `response`, shortened until the merit decreases, and the accepted
    /// share; none if the merit decreases for no length.
    pub(super) fn search(
        &self,
        state: &ContactIterate,
        active: &[bool],
        response: &Response,
        near: bool,
        penalty: &mut f64,
    ) -> Option<(ContactIterate, f64)> {
        let target = along(&response.reactions, &state.touches);
        let ends = response.displacements.iter().zip(&state.displacements);
        let way = Way {
            state,
            active,
            forces: (0..self.count()).map(|i| if active[i] { target[i] } else { 0.0 }).collect(),
            ways: ends.map(|(to, from)| sub(*to, *from)).collect(),
        };
        let reach = (STEADY_GAP * farthest(&state.touches, active)).max(self.seats.reach());
        // For the last steps, changes of the merit are mostly rounding errors.
        let negligible = BALANCE_SHARE * self.sliding.gap_limit(self.options);
        let is_tiny = near || way.ways.iter().all(|way| norm(*way) <= negligible);
        let slope = match response.slopes {
            Some((first, _)) if !is_tiny => self.slope(&way, first, penalty)?,
            _ => 0.0,
        };
        let work = state.reactions.iter().zip(&response.reactions).zip(&way.ways);
        let work: f64 = work.map(|((a, b), way)| (norm(*a) + norm(*b)) * norm(*way)).sum();
        let rounding = MERIT_ROUNDING * work;
        let descent = Descent { slope, slack: rounding };
        let found = first_of_halves(SHORTEST, |share| {
            let displacements = between(&state.displacements, &response.displacements, share);
            let touches = self.seats.touches(&self.places(&displacements));
            let within = farthest(&touches, active) <= reach;
            let falls = || match response.slopes {
                Some(slopes) if !is_tiny => {
                    let rise = self.rise(&way, &touches, slopes, share, *penalty);
                    descent.accepts(share, 0.0, rise)
                }
                _ => true,
            };
            (within && falls()).then_some((displacements, touches))
        });
        let ((displacements, touches), share) = found?;
        let reactions = between(&state.reactions, &response.reactions, share);
        Some((self.reached(displacements, touches, reactions, active), share))
    }

    /// Slope of the merit at the start of a step, made negative by increasing the penalty; none if no penalty
    /// achieves that.
    ///
    /// `energy`: the slope of the elastic energy.
    fn slope(&self, way: &Way<'_>, energy: f64, penalty: &mut f64) -> Option<f64> {
        let Way { state, active, forces, ways } = way;
        let at = |penalty: f64| {
            let (mut slope, mut closing) = (energy, 0.0);
            for i in 0..self.count() {
                let own = self.sliding.stiffness[i];
                let touch = &state.touches[i];
                let rate = touch.level_rate(ways[i]);
                let turn = touch.multiplier(forces[i] - state.forces[i]);
                let multiplier = touch.multiplier(state.forces[i]);
                let (by_level, by_force) =
                    self.merit_slopes(multiplier, touch.level(), penalty * own);
                slope += by_level * rate + by_force * turn;
                if active[i] {
                    closing -= own * touch.level() * rate;
                }
            }
            (slope, closing)
        };
        let (slope, closing) = at(*penalty);
        // Terms independent of the penalty, and the decrease due to closing gaps: the latter must clearly
        // dominate.
        let rest = slope + *penalty * closing;
        if rest <= CLOSING_SHARE * *penalty * closing {
            return Some(slope).filter(|slope| *slope < 0.0);
        }
        let needed = rest / (CLOSING_SHARE * closing);
        if !(needed > *penalty && needed <= MOST_PENALTY) {
            return Some(slope).filter(|slope| *slope < 0.0);
        }
        *penalty = needed;
        Some(at(needed).0).filter(|slope| *slope < 0.0)
    }

    /// Increase of the merit over `share` of a step to the state with the contact values `touches`.
    ///
    /// `slopes`: slopes of the elastic energy at the start and at the end of the whole step.
    fn rise(
        &self,
        way: &Way<'_>,
        touches: &[LocalShape],
        (first, last): (f64, f64),
        share: f64,
        penalty: f64,
    ) -> f64 {
        let Way { state, forces, .. } = way;
        let mut rise = share * first + 0.5 * share * share * (last - first);
        for i in 0..self.count() {
            let rho = penalty * self.sliding.stiffness[i];
            let (here, there) = (&state.touches[i], &touches[i]);
            let start = here.multiplier(state.forces[i]);
            let end = start + share * here.multiplier(forces[i] - state.forces[i]);
            let before = self.merit(start, here.level(), rho);
            let after = self.merit(end, there.level(), rho);
            rise += after - before;
        }
        rise
    }

    /// Term of one node in the augmented Lagrangian.
    fn merit(&self, multiplier: f64, level: f64, rho: f64) -> f64 {
        if self.is_unilateral() && multiplier < rho * level {
            return -0.5 * multiplier * multiplier / rho;
        }
        (0.5 * rho * level - multiplier) * level
    }

    /// Its derivatives with respect to level and multiplier.
    fn merit_slopes(&self, multiplier: f64, level: f64, rho: f64) -> (f64, f64) {
        if self.is_unilateral() && multiplier < rho * level {
            return (0.0, -multiplier / rho);
        }
        (rho * level - multiplier, -level)
    }
}
