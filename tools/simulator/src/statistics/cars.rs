//! What points on cars are like.

use realo_schemas::Box3;

use super::rings::{self, column_step};
use super::{
    ABOVE_GROUND, AROUND, FAR, LEAST_POINTS, LOWER_BODY, MIDDLING, NEAR, Observed, Parts, Statistics, WINDOWS, is_car,
};

impl Statistics {
    /// Rays that found nothing between two that met the same car's lower body.
    pub(super) fn add_bodies(&mut self, parts: &Parts) {
        let Some(step) = column_step(&parts.rings) else { return };
        for (number, object) in parts
            .observed
            .objects
            .iter()
            .enumerate()
            .filter(|(_, object)| is_car(object))
        {
            let bin = match parts.observed.range(object) {
                r if r < NEAR => 0,
                r if r < MIDDLING => 1,
                _ => continue,
            };
            for ring in &parts.rings {
                let share = |i: usize| parts.observed.share(object, &parts.points[i]);
                let on = |seen: &&rings::Seen| parts.object[seen.index as usize] == Some(number);
                let body = |seen: &&rings::Seen| on(seen) && LOWER_BODY.contains(&share(seen.index as usize));
                let hits: Vec<f64> = ring.points.iter().filter(body).map(|seen| seen.azimuth).collect();
                if let [first, .., last] = hits[..]
                    && last - first < 1.5
                {
                    // Whatever stands before the car answers as well: only where nothing came back was no answer.
                    let span = ring.points.partition_point(|seen| seen.azimuth < first)
                        ..ring.points.partition_point(|seen| seen.azimuth <= last);
                    let gaps = ring.points[span]
                        .windows(2)
                        .map(|pair| (pair[1].azimuth - pair[0].azimuth) / step);
                    self.bodies[bin].all += ((last - first) / step).round() as usize + 1;
                    self.bodies[bin].some += gaps.map(|gap| (gap.round() as usize).saturating_sub(1)).sum::<usize>();
                }
            }
        }
    }

    /// How deep in the boxes of cars those rays end that met the lower body or a window.
    pub(super) fn add_depths(&mut self, parts: &Parts) {
        for (point, number) in parts.points.iter().zip(&parts.object) {
            let Some(object) = number
                .map(|number| &parts.observed.objects[number])
                .filter(|object| is_car(object))
            else {
                continue;
            };
            let Some(depth) = depth(parts.observed, object, point) else {
                continue;
            };
            let (range, share) = (parts.observed.range(object), parts.observed.share(object, point));
            if LOWER_BODY.contains(&share) {
                let bin = usize::from(range >= NEAR) + usize::from(range >= MIDDLING);
                self.metal[bin].push(depth);
            } else if WINDOWS.contains(&share) && range < NEAR {
                self.windows.push(depth);
            }
        }
    }

    pub(super) fn add_far_cars(&mut self, parts: &Parts) {
        let sensor = parts.observed.sensor;
        let background: Vec<usize> = parts.background(0.3, 3.5).collect();
        for (number, object) in parts.observed.objects.iter().enumerate() {
            let range = parts.observed.range(object);
            let [x, y] = [0, 1].map(|k| object.center[k] - sensor[k]);
            let ahead = libm::atan2(y, x).abs() < parts.observed.sector / 2.0;
            let Some(bin) = FAR.iter().position(|far| far.contains(&range)) else {
                continue;
            };
            if !is_car(object) || !ahead {
                continue;
            }
            // Boxes reach a little into the ground.
            let on_it = |i: &usize| parts.object[*i] == Some(number) && parts.above[*i] > ABOVE_GROUND;
            let own = (0..parts.points.len()).filter(on_it).count();
            if own < LEAST_POINTS {
                continue;
            }
            let near = |i: &&usize| (parts.points[**i][0] - x).hypot(parts.points[**i][1] - y) < AROUND;
            self.far[bin].own.push(own as f64);
            self.far[bin].around.push(background.iter().filter(near).count() as f64);
        }
    }
}

/// A point relative to the sensor, in the frame of a box's centre.
pub(super) fn into_box(observed: &Observed, object: &Box3, point: &[f64; 3]) -> [f64; 3] {
    let [x, y, z] = [0, 1, 2].map(|k| point[k] + observed.sensor[k] - object.center[k]);
    let (sin, cos) = libm::sincos(object.yaw);
    [x * cos + y * sin, y * cos - x * sin, z]
}

/// How far behind the place where it enters a box a ray got, m; `None` if it passes beside the box.
pub(super) fn depth(observed: &Observed, object: &Box3, point: &[f64; 3]) -> Option<f64> {
    let end = into_box(observed, object, point);
    let start = into_box(observed, object, &[0.0; 3]);
    let half = [object.length, object.width, object.height].map(|size| size / 2.0);
    let (mut enter, mut leave) = (f64::MIN, f64::MAX);
    for k in 0..3 {
        let step = end[k] - start[k];
        let (a, b) = ((-half[k] - start[k]) / step, (half[k] - start[k]) / step);
        (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
    }
    let length = (0..3)
        .map(|k| (end[k] - start[k]) * (end[k] - start[k]))
        .sum::<f64>()
        .sqrt();
    (enter <= leave).then_some((1.0 - enter) * length)
}
