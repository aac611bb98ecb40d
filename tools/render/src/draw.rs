use crate::drawing::{Dots, Drawing, Item};
use crate::font::{Fonts, Weight};
use crate::judge::{Detected, There};
use crate::labels::{Wanted, place};
use crate::legend;
use crate::marks::{agent_mark, box_path, box_rect, crossed_path, headed_path, headed_rect};
use crate::scene::Scene;
use crate::style::{self, Style};
use crate::thin::{STEPS, thin};
use crate::view::{Rect, TOP, View, WIDTH, line, polygon};

/// Smallest distance of dots, m.
const DOT_CELL_M: f64 = 0.2;
/// Diameter of dots, px.
const DOT_PX: f64 = 1.5;
/// Distance of grid lines, m.
const GRID_M: f64 = 20.0;

/// Draws a scene: the view, then title and legend around it.
///
/// Every detection and every object is one mark of a class: `added` (true, on what the ego alone does not see), `hit`
/// (true otherwise), `false`, `detected` (nothing is known of the truth), `there` (found) and `missed`.
pub fn draw(scene: &Scene) -> Drawing {
    let fonts = Fonts::new();
    let view = View::of(&scene.region);
    let mut drawing = Drawing {
        size: [WIDTH, TOP],
        title: legend::title(scene),
        ground: style::GROUND,
        items: Vec::new(),
    };
    let shown = view.rect(&view.shown);
    drawing.mark("view", rect_path(&shown), style::filled(style::VIEW));
    grid(&mut drawing, &view);
    let cell = points(&mut drawing, &view, scene);
    drawing.mark("region", rect_path(&view.rect(&scene.region)), style::REGION);
    let mut notes = vec![legend::about_points(cell)];
    let bar = legend::scale_bar(&mut drawing, &fonts, &view);
    boxes(&mut drawing, &view, scene);
    agents(&mut drawing, &view, scene);
    let left_out = labels(&mut drawing, &fonts, &view, scene, bar);
    notes.extend(legend::about_boxes(scene, left_out));
    legend::head(&mut drawing, &fonts, scene);
    legend::legend(&mut drawing, &fonts, &view, scene, &notes);
    drawing
}

fn rect_path(rect: &Rect) -> String {
    polygon(&[
        [rect.left, rect.top],
        [rect.right, rect.top],
        [rect.right, rect.bottom],
        [rect.left, rect.bottom],
    ])
}

fn grid(drawing: &mut Drawing, view: &View) {
    let ([x0, x1], [y0, y1]) = (view.shown.x, view.shown.y);
    let steps = |[from, to]: [f64; 2]| (from / GRID_M).ceil() as i32..=(to / GRID_M).floor() as i32;
    for x in steps(view.shown.x).map(|step| GRID_M * f64::from(step)) {
        drawing.mark("grid", line(view.px([x, y0]), view.px([x, y1])), style::GRID);
    }
    for y in steps(view.shown.y).map(|step| GRID_M * f64::from(step)) {
        drawing.mark("grid", line(view.px([x0, y]), view.px([x1, y])), style::GRID);
    }
}

/// All agents' points, those on the ground first and faint; gives the smallest distance of dots, m.
fn points(drawing: &mut Drawing, view: &View, scene: &Scene) -> f64 {
    let clouds: Vec<&[[f32; 3]]> = scene.agents.iter().map(|agent| &agent.points[..]).collect();
    let (cell, thinned) = thin(&clouds, &view.shown, DOT_CELL_M);
    let step = cell / f64::from(STEPS);
    let mut raised = Vec::new();
    for (index, dots) in thinned.into_iter().enumerate() {
        let of = |cells, alpha, diameter| Dots {
            color: style::agent(index),
            alpha,
            diameter,
            origin: view.px([view.shown.x[0] + step / 2.0, view.shown.y[0] + step / 2.0]),
            cell: step * view.scale,
            cells,
        };
        drawing.items.push(Item::Dots(of(dots.ground, 0.3, DOT_PX * 0.8)));
        raised.push(Item::Dots(of(dots.raised, 0.85, DOT_PX)));
    }
    drawing.items.extend(raised);
    cell
}

fn boxes(drawing: &mut Drawing, view: &View, scene: &Scene) {
    for object in &scene.judged.there {
        let (class, style) = look_of_object(object);
        drawing.reported(
            class,
            Some(object.class.clone()),
            box_path(view, &object.outline),
            style,
        );
    }
    // What matters most lies on top.
    let mut order: Vec<(&Detected, Look)> = scene
        .judged
        .detected
        .iter()
        .map(|detection| (detection, Look::of(scene, detection)))
        .collect();
    order.sort_by_key(|(_, look)| *look);
    for (detection, look) in order {
        let path = match look {
            Look::False => crossed_path(view, &detection.outline),
            _ => headed_path(view, &detection.outline),
        };
        let (class, style) = look.style();
        drawing.reported(class, Some(text_of(detection)), path, style);
    }
}

fn look_of_object(object: &There) -> (&'static str, Style) {
    match object.found {
        true => ("there", style::THERE),
        false => ("missed", style::MISSED),
    }
}

fn text_of(detection: &Detected) -> String {
    format!("{} {:.2}", detection.class, detection.score)
}

/// What a detection is, smallest important first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Look {
    Detected,
    Hit,
    False,
    Added,
}

impl Look {
    fn of(scene: &Scene, detection: &Detected) -> Self {
        match detection.found {
            _ if !scene.has_truth => Look::Detected,
            _ if scene.judged.only_cooperation(detection) => Look::Added,
            Some(_) => Look::Hit,
            None => Look::False,
        }
    }

    fn style(self) -> (&'static str, Style) {
        match self {
            Look::Detected => ("detected", style::HIT),
            Look::Hit => ("hit", style::HIT),
            Look::False => ("false", style::FALSE),
            Look::Added => ("added", style::ADDED),
        }
    }

    /// Colour, size (px) and weight of its label.
    fn letters(self) -> (&'static str, f64, Weight) {
        match self {
            Look::Detected | Look::Hit => (style::MUTED, 10.2, Weight::Regular),
            Look::False => (style::WRONG, 10.5, Weight::Bold),
            Look::Added => (style::COOPERATION, 11.0, Weight::Bold),
        }
    }
}

fn agents(drawing: &mut Drawing, view: &View, scene: &Scene) {
    for (index, agent) in scene.agents.iter().enumerate().rev() {
        let mark = agent_mark(view, agent);
        let style = style::agent_body(style::agent(index));
        drawing.reported("agent", Some(agent.name.clone()), mark.path, style);
    }
}

struct Label {
    text: String,
    object: Rect,
    color: &'static str,
    size: f64,
    weight: Weight,
}

/// Draws the labels that find a place; gives the number of those that do not.
fn labels(drawing: &mut Drawing, fonts: &Fonts, view: &View, scene: &Scene, bar: Rect) -> usize {
    let labels = wanted(view, scene);
    let size = |label: &Label| {
        [
            fonts.width(&label.text, label.size, label.weight) + 2.0,
            label.size * 1.02,
        ]
    };
    let wanted: Vec<Wanted> = labels
        .iter()
        .map(|label| Wanted {
            object: label.object,
            size: size(label),
        })
        .collect();
    let mut obstacles: Vec<Rect> = labels.iter().map(|label| label.object).collect();
    let judged = &scene.judged;
    obstacles.extend(judged.there.iter().map(|object| box_rect(view, &object.outline)));
    obstacles.push(bar);
    let placed = place(&wanted, &obstacles, &view.rect(&view.shown).grown(-2.0));
    for (label, placed) in labels.iter().zip(&placed) {
        let Some(placed) = placed else { continue };
        if let Some([from, to]) = placed.leader {
            drawing.mark("leader", line(from, to), style::leader(label.color));
        }
        let start = [placed.rect.left + 1.0, placed.rect.bottom - 0.24 * label.size];
        let path = fonts.outline(&label.text, start, label.size, label.weight);
        drawing.mark("label", path, style::letters(label.color));
    }
    placed.iter().filter(|placed| placed.is_none()).count()
}

/// All labels, the most important first.
fn wanted(view: &View, scene: &Scene) -> Vec<Label> {
    let mut labels = Vec::new();
    for (index, agent) in scene.agents.iter().enumerate() {
        let mark = agent_mark(view, agent);
        let [x, y] = agent.position;
        let text = match (index, mark.beyond) {
            (0, _) => format!("{} (ego)", agent.name),
            (_, true) => format!("{} ({:.0} m away)", agent.name, x.hypot(y)),
            (_, false) => agent.name.clone(),
        };
        labels.push(Label {
            text,
            object: mark.rect,
            color: style::agent(index),
            size: 14.0,
            weight: Weight::Bold,
        });
    }
    let mut detections: Vec<(&Detected, Look)> = scene
        .judged
        .detected
        .iter()
        .map(|detection| (detection, Look::of(scene, detection)))
        .collect();
    detections.sort_by_key(|(_, look)| std::cmp::Reverse(*look));
    let (important, plain): (Vec<_>, Vec<_>) = detections.into_iter().partition(|(_, look)| *look > Look::Hit);
    let label = |(detection, look): &(&Detected, Look)| {
        let (color, size, weight) = look.letters();
        Label {
            text: text_of(detection),
            object: headed_rect(view, &detection.outline),
            color,
            size,
            weight,
        }
    };
    labels.extend(important.iter().map(label));
    let missed = scene.judged.there.iter().filter(|object| !object.found);
    labels.extend(missed.map(|object| Label {
        text: object.class.clone(),
        object: box_rect(view, &object.outline),
        color: style::WRONG,
        size: 10.5,
        weight: Weight::Regular,
    }));
    labels.extend(plain.iter().map(label));
    labels
}
