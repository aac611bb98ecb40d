use damage::Draw;
use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use proptest::prelude::*;

use super::*;
use crate::factor::Linear;
use crate::rotation::{between, turned};

fn pose(shift: [f64; 3], turn: [f64; 3]) -> Isometry3<f64> {
    let turn = turned(&UnitQuaternion::identity(), &Vector3::from(turn));
    Isometry3::from_parts(Translation3::from(Vector3::from(shift)), turn)
}

/// A factor at some poses.
type Factor<'a> = &'a dyn Fn(&[Isometry3<f64>]) -> Linear;

/// Information of a standard deviation of places, m, and of turns, rad.
fn sure(place: f64, turn: f64) -> Matrix6<f64> {
    let [p, t] = [place, turn].map(|sigma| 1.0 / (sigma * sigma));
    Matrix6::from_diagonal(&Vector6::new(p, p, p, t, t, t))
}

fn edge(nodes: &[Isometry3<f64>], from: usize, to: usize, kernel: Option<f64>) -> Edge {
    Edge {
        from,
        to,
        from_from_to: nodes[from].inv_mul(&nodes[to]),
        information: sure(0.02, 1e-3),
        kernel,
    }
}

fn fixed(node: usize, at: &Isometry3<f64>) -> Prior {
    Prior {
        node,
        map_from_body: *at,
        information: Vector6::repeat(1e8),
    }
}

fn off(a: &Isometry3<f64>, b: &Isometry3<f64>) -> [f64; 2] {
    let place = (a.translation.vector - b.translation.vector).norm();
    [place, between(&a.rotation, &b.rotation).norm()]
}

/// Twice round a circle of 40 m, 40 poses each.
fn laps() -> Vec<Isometry3<f64>> {
    let on_circle = |at: usize| {
        let angle = std::f64::consts::TAU * at as f64 / 40.0;
        let (sin, cos) = libm::sincos(angle);
        pose(
            [40.0 * cos, 40.0 * sin, 0.1 * sin],
            [0.0, 0.0, angle % std::f64::consts::TAU],
        )
    };
    (0..80).map(on_circle).collect()
}

/// Odometry of some poses that turns too far and says 1 % too much.
fn drifting(truth: &[Isometry3<f64>]) -> PoseGraph {
    let mut graph = PoseGraph {
        nodes: vec![truth[0]],
        priors: vec![fixed(0, &truth[0])],
        ..PoseGraph::default()
    };
    for at in 1..truth.len() {
        let mut edge = edge(truth, at - 1, at, None);
        // It says of itself how far it is off.
        edge.information = sure(0.07, 2e-3);
        edge.from_from_to.translation.vector *= 1.01;
        edge.from_from_to.rotation = turned(&edge.from_from_to.rotation, &Vector3::new(0.0, 0.0, 1e-3));
        let next = graph.nodes[at - 1] * edge.from_from_to;
        graph.nodes.push(next);
        graph.edges.push(edge);
    }
    graph
}

fn worst(nodes: &[Isometry3<f64>], truth: &[Isometry3<f64>]) -> [f64; 2] {
    let each = nodes.iter().zip(truth).map(|(a, b)| off(a, b));
    each.fold([0.0; 2], |most, [place, turn]| {
        [f64::max(most[0], place), f64::max(most[1], turn)]
    })
}

#[test]
fn a_chain_and_a_shorter_loop_share_the_difference() {
    let straight: Vec<_> = (0..=10)
        .map(|x| pose([1.04 * f64::from(x), 0.0, 0.0], [0.0; 3]))
        .collect();
    let mut graph = PoseGraph {
        nodes: straight.clone(),
        edges: (1..=10).map(|at| edge(&straight, at - 1, at, None)).collect(),
        priors: vec![fixed(0, &straight[0])],
        ..PoseGraph::default()
    };
    let mut shorter = edge(&straight, 0, 10, None);
    shorter.from_from_to = pose([10.0, 0.0, 0.0], [0.0; 3]);
    graph.edges.push(shorter);
    let solution = graph.solve(&SolverSettings::default()).unwrap();
    assert!(
        solution.converged && solution.cost[1] < solution.cost[0],
        "{solution:?}"
    );
    // 10 (D/10 − 1.04)² + (D − 10)² is smallest at D = 11.04 / 1.1.
    let found = graph.nodes[10].translation.x;
    assert!((found - 11.04 / 1.1).abs() < 1e-4, "{found}");
    for (at, node) in graph.nodes.iter().enumerate() {
        assert!((node.translation.x - found * at as f64 / 10.0).abs() < 1e-4);
    }
}

#[test]
fn loops_take_the_drift_out_and_a_wrong_one_is_let_go() {
    let truth = laps();
    let mut graph = drifting(&truth);
    let drift = worst(&graph.nodes, &truth);
    assert!(drift[0] > 2.0, "{drift:?}");
    for at in (40..80).step_by(5) {
        graph.edges.push(edge(&truth, at - 40, at, Some(3.0)));
    }
    // A street that looks like another one.
    graph.edges.push(Edge {
        from_from_to: pose([1.0, 2.0, 0.0], [0.0, 0.0, 0.3]),
        ..edge(&truth, 10, 70, Some(3.0))
    });
    let solution = graph.solve(&SolverSettings::default()).unwrap();
    let (wrong, right) = solution.edge_weights[79..].split_last().unwrap();
    assert!(
        *wrong < 1e-3 && right.iter().all(|weight| *weight > 0.5),
        "{wrong} {right:?}"
    );
    let left = worst(&graph.nodes, &truth);
    // 1 % of the circle's 80 m stays: no loop tells how long a metre is.
    assert!(left[0] < 0.9 && left[0] < 0.3 * drift[0], "{drift:?} {left:?}");
    // Where it was before it is again.
    let [place, turn] = off(&graph.nodes[20], &graph.nodes[60]);
    assert!(place < 0.05 && turn < 0.01, "{place} {turn}");
}

#[test]
fn positions_place_a_drive_and_jumps_of_them_do_not() {
    let truth = laps();
    let mut graph = drifting(&truth);
    graph.priors.clear();
    let antenna = Vector3::new(-0.5, 0.0, 1.6);
    let mut draw = Draw::new(8);
    let mut noise = || draw.below(2_000_000) as f64 * 1e-6 - 1.0;
    for (at, pose) in truth.iter().enumerate() {
        let mut position = (pose * nalgebra::Point3::from(antenna)).coords;
        position += Vector3::new(noise(), noise(), noise()) * 0.2;
        if at % 7 == 3 {
            position += Vector3::new(9.0, -6.0, 4.0);
        }
        graph.anchors.push(Anchor {
            node: at,
            antenna,
            position,
            information: Vector3::repeat(1.0 / 0.04),
            kernel: Some(3.0),
        });
        graph.levels.push(Level { node: at, sigma: 2e-3 });
    }
    let solution = graph.solve(&SolverSettings::default()).unwrap();
    for (at, weight) in solution.anchor_weights.iter().enumerate() {
        assert!((*weight < 0.05) == (at % 7 == 3), "{at}: {weight}");
    }
    let left = worst(&graph.nodes, &truth);
    assert!(left[0] < 0.3 && left[1] < 0.02, "{left:?}");
}

#[test]
fn a_graph_without_a_gauge_is_refused_and_with_one_it_is_only_moved_by_it() {
    let truth = laps();
    let mut free = drifting(&truth);
    free.priors.clear();
    assert_eq!(free.covariances(&[0]), Err(GraphError::Undetermined));
    let mut here = drifting(&truth);
    here.edges.push(edge(&truth, 0, 79, None));
    let mut there = here.clone();
    let moved = pose([500.0, -2e3, 7.0], [0.1, -0.2, 2.0]);
    there.nodes.iter_mut().for_each(|node| *node = moved * *node);
    there.priors = vec![fixed(0, &(moved * truth[0]))];
    for graph in [&mut here, &mut there] {
        assert!(graph.solve(&SolverSettings::default()).unwrap().converged);
    }
    for (a, b) in here.nodes.iter().zip(&there.nodes) {
        let [place, turn] = off(&(moved * a), b);
        assert!(place < 1e-5 && turn < 1e-7, "{place} {turn}");
    }
}

#[test]
fn covariances_of_a_chain_add_up() {
    let straight: Vec<_> = (0..5).map(|x| pose([0.0, 0.0, f64::from(x)], [0.0; 3])).collect();
    let mut graph = PoseGraph {
        nodes: straight.clone(),
        edges: (1..5).map(|at| edge(&straight, at - 1, at, None)).collect(),
        priors: vec![fixed(0, &straight[0])],
        ..PoseGraph::default()
    };
    graph.solve(&SolverSettings::default()).unwrap();
    let found = graph.covariances(&[0, 4]).unwrap();
    assert!((found[0][(2, 2)] - 1e-8).abs() < 1e-10);
    // Along the chain 4 times the variance of one; turns too; across it, what turns before it add: 0² + 1² + 2² + 3².
    assert!((found[1][(2, 2)] - 4.0 * 4e-4).abs() < 1e-6, "{}", found[1]);
    assert!((found[1][(5, 5)] - 4.0 * 1e-6).abs() < 1e-7);
    let across = 4.0 * 4e-4 + 14.0 * 1e-6;
    assert!((found[1][(0, 0)] - across).abs() < 1e-6, "{}", found[1]);
}

#[test]
fn factors_of_nothing_and_numbers_that_are_none_are_refused() {
    let truth = laps();
    let solved = |change: &dyn Fn(&mut PoseGraph)| {
        let mut graph = drifting(&truth);
        change(&mut graph);
        graph.solve(&SolverSettings::default()).unwrap_err().to_string()
    };
    let text = solved(&|graph| graph.edges[3].to = 80);
    assert!(text.contains("pose 80") && text.contains("has 80"), "{text}");
    let text = solved(&|graph| graph.edges[3].information[(2, 2)] = f64::NAN);
    assert!(text.starts_with("edge 3: expected finite numbers"), "{text}");
    let text = solved(&|graph| graph.nodes[9].translation.x = f64::INFINITY);
    assert!(text.starts_with("pose 9"), "{text}");
}

proptest! {
    /// Jacobians by differences.
    #[test]
    fn residuals_change_as_the_jacobians_say(
        shifts in prop::array::uniform2(prop::array::uniform3(-20f64..20.0)),
        turns in prop::array::uniform2(prop::array::uniform3(-1f64..1.0)),
        away in prop::array::uniform3(-1f64..1.0),
        axis in 0usize..6,
    ) {
        let nodes = [pose(shifts[0], turns[0]), pose(shifts[1], turns[1])];
        let target = pose(away, away);
        let edge = Edge { from: 0, to: 1, from_from_to: nodes[0].inv_mul(&nodes[1]) * target, information: Matrix6::identity(), kernel: None };
        let anchor = Anchor { node: 0, antenna: away.into(), position: Vector3::zeros(), information: Vector3::repeat(1.0), kernel: None };
        let prior = Prior { node: 0, map_from_body: nodes[0] * target, information: Vector6::repeat(1.0) };
        let factors: [Factor; 4] = [
            &|nodes| edge.linear(nodes),
            &|nodes| anchor.linear(nodes),
            &|nodes| Level { node: 0, sigma: 1.0 }.linear(nodes),
            &|nodes| prior.linear(nodes),
        ];
        for (number, factor) in factors.iter().enumerate() {
            let linear = factor(&nodes);
            for (node, jacobian) in [Some(linear.first), linear.second].into_iter().flatten() {
                let step = 1e-6;
                let at = |size: f64| {
                    let mut moved = nodes;
                    let mut change = Vector6::zeros();
                    change[axis] = size;
                    let shift = change.fixed_rows::<3>(0).into_owned();
                    moved[node].translation.vector += shift;
                    moved[node].rotation = turned(&moved[node].rotation, &change.fixed_rows::<3>(3).into_owned());
                    factor(&moved).residual
                };
                let slope = (at(step) - at(-step)) / (2.0 * step);
                let found = jacobian.column(axis).into_owned();
                prop_assert!((slope - found).norm() < 1e-6 * (1.0 + found.norm()), "factor {number}: {slope} {found}");
            }
        }
    }
}
