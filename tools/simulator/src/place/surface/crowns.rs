//! Roads that are higher in their middle.

use super::bounds;
use super::field::Field;
use super::ribbon::beside;
use crate::place::network::Road;

/// How much lower than its roads' middles the ground is at a point, m: roads are crowned by 2 %, less near nodes.
pub(crate) struct Crowns {
    fields: Vec<Field<f32>>,
}

impl Crowns {
    pub fn new(roads: &[Road], cell: f64) -> Self {
        let bounds = bounds(roads);
        let fields = roads.iter().map(|road| {
            let half = road.section.half();
            let at = beside(&road.line, bounds, cell, half + 16.0);
            let mut field = Field::new(bounds, cell, 0f32);
            let [from, to] = road.span();
            let length = road.line.length();
            for (i, place) in at.found(&field) {
                let (s, across) = (f64::from(place.along), f64::from(place.across).abs());
                let ramp = |v: f64| (v / 12.0).clamp(0.0, 1.0);
                let near = [(0, s - from), (1, to - s)];
                let share = near.iter().fold(1.0f64, |share, (end, beyond)| {
                    let end = if road.ends[*end].is_some() { ramp(*beyond) } else { 1.0 };
                    share.min(end)
                });
                let beside = 1.0 - ((across - half) / 15.0).clamp(0.0, 1.0);
                if (0.0..=length).contains(&s) {
                    field.values[i] = (-0.02 * across.min(half) * share * beside) as f32;
                }
            }
            field
        });
        Crowns {
            fields: fields.collect(),
        }
    }

    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.fields.iter().filter_map(|field| field.at(x, y)).sum()
    }
}
