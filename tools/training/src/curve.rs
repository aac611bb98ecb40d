//! The course of a training, as data and as a picture.

use std::fmt::Write;

/// One step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Steps before it.
    pub step: u64,
    /// Loss of the scores.
    pub class: f64,
    /// Loss of the boxes.
    pub regression: f64,
    /// Loss of the lessons of a teacher.
    pub lesson: f64,
    /// Length of the gradient.
    pub gradient: f64,
    /// Learning rate.
    pub rate: f64,
    /// Time that it took, s.
    pub seconds: f64,
}

impl Point {
    /// Numbers of a point.
    pub(crate) const NUMBERS: usize = 7;

    /// All parts of the loss.
    pub fn loss(&self) -> f64 {
        self.class + self.regression + self.lesson
    }

    pub(crate) fn to_numbers(self) -> [f64; Self::NUMBERS] {
        [
            self.step as f64,
            self.class,
            self.regression,
            self.lesson,
            self.gradient,
            self.rate,
            self.seconds,
        ]
    }

    pub(crate) fn from_numbers(
        &[step, class, regression, lesson, gradient, rate, seconds]: &[f64; Self::NUMBERS],
    ) -> Self {
        Point {
            step: step as u64,
            class,
            regression,
            lesson,
            gradient,
            rate,
            seconds,
        }
    }
}

/// All steps so far.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    /// In order.
    pub points: Vec<Point>,
}

const WIDTH: f64 = 800.0;
const HEIGHT: f64 = 400.0;
const MARGIN: f64 = 50.0;

/// Points of a line in the picture.
const DETAIL: usize = 400;

impl Curve {
    /// Time of all steps, s.
    pub fn seconds(&self) -> f64 {
        self.points.iter().map(|point| point.seconds).sum()
    }

    /// A line for each step, after one with names.
    pub fn to_csv(&self) -> String {
        let mut text = String::from("step,loss,class_loss,box_loss,lesson_loss,gradient_norm,learning_rate,seconds\n");
        for p in &self.points {
            let (loss, step) = (p.loss(), p.step);
            let rest = (p.class, p.regression, p.lesson, p.gradient, p.rate, p.seconds);
            let (class, regression, lesson, gradient, rate, seconds) = rest;
            let _ = writeln!(
                text,
                "{step},{loss:.5},{class:.5},{regression:.5},{lesson:.5},{gradient:.4},{rate:.3e},{seconds:.3}"
            );
        }
        text
    }

    /// A drawing of the losses on a logarithmic scale and of the learning rate; each point is the mean of some steps.
    pub fn to_svg(&self) -> String {
        let means = self.means();
        let last = self.points.last().map_or(1.0, |point| point.step.max(1) as f64);
        let losses = means
            .iter()
            .flat_map(|p| [p.loss(), p.class, p.regression])
            .filter(|v| *v > 0.0);
        let (min, most) = losses.fold((f64::INFINITY, 0.0_f64), |(min, most), v| (min.min(v), most.max(v)));
        let (low, high) = match min < most {
            true => (min.log10().floor(), most.log10().ceil()),
            false => (-1.0, 1.0),
        };
        let max = means.iter().map(|p| p.rate).fold(f64::MIN_POSITIVE, f64::max);
        let x = |step: u64| MARGIN + step as f64 / last * (WIDTH - 2.0 * MARGIN);
        let up = |share: f64| HEIGHT - MARGIN - share * (HEIGHT - 2.0 * MARGIN);
        let y = |loss: f64| up((loss.max(1e-30).log10() - low) / (high - low));
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"white\"/>\n"
        );
        for power in low as i32..=high as i32 {
            let at = y(10f64.powi(power));
            let right = WIDTH - MARGIN;
            let _ = writeln!(
                svg,
                "<line x1=\"{MARGIN}\" y1=\"{at:.1}\" x2=\"{right}\" y2=\"{at:.1}\" stroke=\"#ccc\"/>"
            );
            let _ = writeln!(svg, "<text x=\"8\" y=\"{:.1}\">1e{power}</text>", at + 4.0);
        }
        type Value = fn(&Point) -> f64;
        let lines: [(&str, &str, Value); 3] = [
            ("loss", "#1f77b4", Point::loss),
            ("scores", "#2ca02c", |p| p.class),
            ("boxes", "#d62728", |p| p.regression),
        ];
        for (index, (name, colour, value)) in lines.into_iter().enumerate() {
            line(&mut svg, colour, means.iter().map(|p| (x(p.step), y(value(p)))));
            legend(&mut svg, index, name, colour);
        }
        line(&mut svg, "#999", means.iter().map(|p| (x(p.step), up(p.rate / max))));
        legend(&mut svg, 3, &format!("learning rate (max {max:.1e})"), "#999");
        let _ = writeln!(
            svg,
            "<text x=\"{:.0}\" y=\"{}\">{last} steps</text>\n</svg>",
            WIDTH - 130.0,
            HEIGHT - 20.0
        );
        svg
    }

    fn means(&self) -> Vec<Point> {
        let width = self.points.len().div_ceil(DETAIL).max(1);
        let mean = |points: &[Point]| {
            let over = |value: fn(&Point) -> f64| points.iter().map(value).sum::<f64>() / points.len() as f64;
            Point {
                step: points[points.len() / 2].step,
                class: over(|p| p.class),
                regression: over(|p| p.regression),
                lesson: over(|p| p.lesson),
                gradient: over(|p| p.gradient),
                rate: over(|p| p.rate),
                seconds: over(|p| p.seconds),
            }
        };
        self.points.chunks(width).map(mean).collect()
    }
}

fn line(svg: &mut String, colour: &str, points: impl Iterator<Item = (f64, f64)>) {
    let points: Vec<String> = points.map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    let _ = writeln!(
        svg,
        "<polyline fill=\"none\" stroke=\"{colour}\" points=\"{}\"/>",
        points.join(" ")
    );
}

fn legend(svg: &mut String, index: usize, name: &str, colour: &str) {
    let x = MARGIN + 120.0 * index as f64;
    let _ = writeln!(svg, "<text x=\"{x}\" y=\"30\" fill=\"{colour}\">{name}</text>");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_becomes_a_table_and_a_picture() {
        let point = |step: u64| {
            let (class, regression) = (1.0 / (step + 1) as f64, 0.5 / (step + 1) as f64);
            Point {
                step,
                class,
                regression,
                lesson: 0.0,
                gradient: 1.0,
                rate: 1e-3,
                seconds: 0.5,
            }
        };
        let curve = Curve {
            points: (0..1000).map(point).collect(),
        };
        let csv = curve.to_csv();
        assert_eq!(csv.lines().count(), 1001);
        assert_eq!(
            csv.lines().nth(1),
            Some("0,1.50000,1.00000,0.50000,0.00000,1.0000,1.000e-3,0.500")
        );
        let svg = curve.to_svg();
        assert_eq!(svg.matches("<polyline").count(), 4);
        assert!(svg.ends_with("</svg>\n") && !svg.contains("NaN"));
        assert!(!Curve::default().to_svg().contains("NaN"));
    }
}
