//! Shapes of boxes and agents.

use realo_logs::AgentKind;
use realo_schemas::geometry::Footprint;
use realo_scoring::Outline;

use crate::scene::Agent;
use crate::view::{Px, Rect, View, footprint, line, polygon};

/// How far a heading mark reaches beyond a box, m.
const BEYOND_M: f64 = 0.9;
/// Half the size of an agent that has no outline, px.
const AGENT_PX: f64 = 7.0;
/// Agents beyond the view are drawn so far from its edge, px.
const EDGE_PX: f64 = 14.0;

/// The rectangle of an outline.
pub fn box_path(view: &View, outline: &Outline) -> String {
    polygon(&corners(view, &footprint(outline)))
}

/// A rectangle and a line from its centre beyond its front.
pub fn headed_path(view: &View, outline: &Outline) -> String {
    let rectangle = footprint(outline);
    let heading = line(view.px(rectangle.center), tip(view, &rectangle));
    format!("{}{heading}", polygon(&corners(view, &rectangle)))
}

/// The end of a heading mark.
fn tip(view: &View, rectangle: &Footprint) -> Px {
    let ([x, y], [cos, sin]) = (rectangle.center, rectangle.heading);
    let reach = rectangle.half[0] + BEYOND_M;
    view.px([x + reach * cos, y + reach * sin])
}

/// A rectangle with its diagonals and its heading.
pub fn crossed_path(view: &View, outline: &Outline) -> String {
    let [a, b, c, d] = corners(view, &footprint(outline));
    format!("{}{}{}", headed_path(view, outline), line(a, c), line(b, d))
}

/// The part of the picture that an outline takes.
pub fn box_rect(view: &View, outline: &Outline) -> Rect {
    Rect::around(&corners(view, &footprint(outline))).grown(1.5)
}

/// The part of the picture that an outline and its heading mark take.
pub fn headed_rect(view: &View, outline: &Outline) -> Rect {
    let rectangle = footprint(outline);
    let [a, b, c, d] = corners(view, &rectangle);
    Rect::around(&[a, b, c, d, tip(view, &rectangle)]).grown(1.5)
}

fn corners(view: &View, rectangle: &Footprint) -> [Px; 4] {
    let Footprint {
        center: [x, y],
        half: [length, width],
        heading: [cos, sin],
        ..
    } = *rectangle;
    [(length, width), (length, -width), (-length, -width), (-length, width)]
        .map(|(along, across)| view.px([x + along * cos - across * sin, y + along * sin + across * cos]))
}

/// An agent in the picture.
pub struct AgentMark {
    /// Its shape.
    pub path: String,
    /// What it takes.
    pub rect: Rect,
    /// Whether it lies beyond what is shown, and is drawn at the edge.
    pub beyond: bool,
}

/// An arrow head as long and wide as the vehicle; a diamond for what has no outline.
pub fn agent_mark(view: &View, agent: &Agent) -> AgentMark {
    let beyond = !view.shown.contains(agent.position);
    let outline = agent.footprint.filter(|_| !beyond && agent.kind == AgentKind::Vehicle);
    let points = match outline {
        Some(footprint) => vehicle(view, agent, footprint).to_vec(),
        None => diamond(inside(view, view.px(agent.position))).to_vec(),
    };
    AgentMark {
        path: polygon(&points),
        rect: Rect::around(&points).grown(2.0),
        beyond,
    }
}

fn vehicle(view: &View, agent: &Agent, [back, front, right, left]: [f64; 4]) -> [Px; 5] {
    let (sin, cos) = agent.yaw.sin_cos();
    let shoulder = front - (front - back) * 0.35;
    let middle = (right + left) / 2.0;
    [
        (front, middle),
        (shoulder, left),
        (back, left),
        (back, right),
        (shoulder, right),
    ]
    .map(|(x, y)| {
        let [x0, y0] = agent.position;
        view.px([x0 + x * cos - y * sin, y0 + x * sin + y * cos])
    })
}

fn diamond([x, y]: Px) -> [Px; 4] {
    [
        [x + AGENT_PX, y],
        [x, y + AGENT_PX],
        [x - AGENT_PX, y],
        [x, y - AGENT_PX],
    ]
}

fn inside(view: &View, [x, y]: Px) -> Px {
    let shown = view.rect(&view.shown).grown(-EDGE_PX);
    [x.clamp(shown.left, shown.right), y.clamp(shown.top, shown.bottom)]
}
