//! What the ego knows when a selection comes.

use nalgebra::Isometry3;
use realo_schemas::{Box3, Boxes, Message, Payload, PointCloud};

use crate::cells::Ground;
use crate::objects::{Object, objects};
use crate::view::View;

/// What the ego knows, in its frame.
pub(crate) struct Sight {
    /// Its objects, and those of collaborators that it has confirmed.
    pub known: Vec<Object>,
    /// How many of them, the first, are its own.
    pub own: usize,
    /// Whether it has boxes at all, which may be none.
    pub has_boxes: bool,
    /// Its sweep, where it is known, what that shows, and the same for a search.
    pub view: Option<View>,
    sweep: Option<PointCloud>,
    ground: Option<Ground>,
}

/// The ego's sweep and what it shows.
pub(crate) struct Sweep<'a> {
    /// Its points.
    pub cloud: &'a PointCloud,
    /// What they show.
    pub view: &'a View,
    /// The same for a search.
    pub ground: &'a Ground,
}

impl Sight {
    /// What a message of the ego and its sweep say; a message of points is a sweep itself, and a map has boxes.
    pub fn of(ego: &Message, map_boxes: Option<Vec<Box3>>, sweep: Option<PointCloud>, max_boxes: usize) -> Self {
        let (own, is_points) = match &ego.payload {
            Payload::PointCloud(cloud) => (Some(cloud.clone()), true),
            _ => (None, false),
        };
        let sweep = own.or(sweep);
        let view = sweep.as_ref().map(View::of);
        let said = match &ego.payload {
            Payload::Boxes(Boxes(boxes)) => Some(boxes),
            _ => map_boxes.as_ref(),
        };
        let known = said.map(|boxes| objects(boxes, &Isometry3::identity(), 0.0, max_boxes));
        Sight {
            has_boxes: known.is_some(),
            own: known.as_ref().map_or(0, Vec::len),
            known: known.unwrap_or_default(),
            ground: view.as_ref().filter(|_| is_points).map(Ground::of_view),
            view,
            sweep,
        }
    }

    /// The ego's sweep, where it may be compared with those of others.
    pub fn sweep(&self) -> Option<Sweep<'_>> {
        let (cloud, view, ground) = (self.sweep.as_ref()?, self.view.as_ref()?, self.ground.as_ref()?);
        Some(Sweep { cloud, view, ground })
    }
}
