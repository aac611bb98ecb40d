//! Where items in layers stand above each other, and how links pass from one to the next. Columns and rows, pixels and
//! characters are the same here: only heights count.

use std::collections::BTreeMap;

/// Something with a place in a layer.
#[derive(Clone, Copy, Debug)]
pub struct Item {
    /// Counted from the left.
    pub layer: usize,
    /// How high it is.
    pub height: f64,
    /// Counted from the top: all of a band is above all of the next one, in every layer.
    pub band: usize,
}

/// A link from the right side of an item to the left side of another.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    /// Index of the item.
    pub from: usize,
    /// How far below its top.
    pub from_y: f64,
    /// Index of the item.
    pub to: usize,
    /// How far below its top.
    pub to_y: f64,
    /// Links of one net share lanes.
    pub net: usize,
}

/// Distances.
#[derive(Clone, Copy, Debug)]
pub struct Gaps {
    /// Between an item and what is next to it.
    pub item: f64,
    /// Between two lanes.
    pub lane: f64,
    /// How high a lane is.
    pub lane_height: f64,
    /// Between two bands.
    pub band: f64,
}

/// A side of a channel and the height there; channel `n` is left of layer `n`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct At {
    /// Whether it is the right side of the channel.
    pub is_right: bool,
    /// From the top of the picture.
    pub y: f64,
}

/// The way of a link through one channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hop {
    /// Which channel.
    pub channel: usize,
    /// Where it comes in.
    pub from: At,
    /// Where it goes out.
    pub to: At,
}

/// Where everything is.
#[derive(Clone, Debug)]
pub struct Arranged {
    /// Of each item.
    pub tops: Vec<f64>,
    /// Of each link the channels in the order in which it passes them; between two it runs straight through a layer.
    pub routes: Vec<Vec<Hop>>,
    /// Top and bottom of each band, its lanes included; `None` where it has nothing.
    pub bands: Vec<Option<[f64; 2]>>,
    /// Of the whole.
    pub height: f64,
}

/// How often the order in layers is improved, and then the places.
const SWEEPS: usize = 16;
/// Nodes of a graph whose links are shortened, at most.
const MOST_SHORTENED: usize = 60;

/// Arranges items; whole heights and gaps give whole places.
pub fn arrange(items: &[Item], links: &[Link], gaps: &Gaps) -> Arranged {
    let mut plan = Plan::new(items, links, gaps);
    let mut best = (plan.cost(), plan.tops.clone(), plan.layers.clone());
    for sweep in 0..SWEEPS {
        plan.sweep(sweep % 2 == 0);
        let cost = plan.cost();
        if sweep == 0 || cost < best.0 {
            best = (cost, plan.tops.clone(), plan.layers.clone());
        }
    }
    (_, plan.tops, plan.layers) = best;
    plan.shorten();
    plan.arranged(items.len())
}

/// One end of a step: a node's side and how far below its top.
#[derive(Clone, Copy)]
struct Side {
    node: usize,
    is_right: bool,
    offset: f64,
}

/// A link's way through a channel, by nodes.
#[derive(Clone, Copy)]
struct Step {
    channel: usize,
    from: Side,
    to: Side,
}

/// Items and lanes.
struct Plan<'a> {
    gaps: &'a Gaps,
    /// Items first, then lanes.
    nodes: Vec<Item>,
    is_lane: Vec<bool>,
    /// Between which heights the nodes of each band are.
    limits: Vec<[f64; 2]>,
    tops: Vec<f64>,
    /// Nodes of each layer from the top.
    layers: Vec<Vec<usize>>,
    steps: Vec<Vec<Step>>,
}

impl<'a> Plan<'a> {
    fn new(items: &[Item], links: &[Link], gaps: &'a Gaps) -> Self {
        let mut plan = Plan {
            gaps,
            nodes: items.to_vec(),
            is_lane: vec![false; items.len()],
            limits: Vec::new(),
            tops: Vec::new(),
            layers: Vec::new(),
            steps: Vec::new(),
        };
        let mut lanes = BTreeMap::new();
        plan.steps = links.iter().map(|link| plan.steps_of(link, &mut lanes)).collect();
        let layers = plan.nodes.iter().map(|node| node.layer + 1).max().unwrap_or(0);
        plan.layers = vec![Vec::new(); layers];
        plan.tops = vec![0.0; plan.nodes.len()];
        for (at, node) in plan.nodes.iter().enumerate() {
            plan.layers[node.layer].push(at);
        }
        plan.limits = plan.limits();
        for layer in 0..layers {
            plan.settle(layer, |_| None);
        }
        plan
    }

    /// Room for each band, one below the other; a single one has all.
    fn limits(&self) -> Vec<[f64; 2]> {
        let count = self.nodes.iter().map(|node| node.band + 1).max().unwrap_or(0);
        if count < 2 {
            return vec![[f64::NEG_INFINITY, f64::INFINITY]; count];
        }
        let mut below = 0.0;
        let mut limits = Vec::with_capacity(count);
        for band in 0..count {
            let rooms = self.layers.iter().map(|nodes| self.room(nodes, band));
            let height = rooms.fold(0.0, f64::max);
            limits.push([below, below + height]);
            below += height + if height > 0.0 { self.gaps.band } else { 0.0 };
        }
        limits
    }

    /// How high the nodes of a band in a layer are at most, in any order.
    fn room(&self, nodes: &[usize], band: usize) -> f64 {
        let members: Vec<usize> = nodes
            .iter()
            .copied()
            .filter(|node| self.nodes[*node].band == band)
            .collect();
        let heights: f64 = members.iter().map(|node| self.nodes[*node].height).sum();
        let gaps = members.len().saturating_sub(1);
        // An item has two neighbours at most.
        let items = members.iter().filter(|node| !self.is_lane[**node]).count();
        let wide = gaps.min(2 * items);
        heights + wide as f64 * self.gaps.item.max(self.gaps.lane) + (gaps - wide) as f64 * self.gaps.lane
    }

    /// A link from layer to layer. What leads back passes through lanes of its own, from right to left.
    fn steps_of(&mut self, link: &Link, lanes: &mut BTreeMap<(usize, bool, usize), usize>) -> Vec<Step> {
        let (from, to) = (self.nodes[link.from].layer, self.nodes[link.to].layer);
        let is_back = to <= from;
        let layers: Vec<usize> = match is_back {
            true => (to..=from).rev().collect(),
            false => (from + 1..to).collect(),
        };
        let half = self.gaps.lane_height / 2.0;
        let mut begin = Side {
            node: link.from,
            is_right: true,
            offset: link.from_y,
        };
        let mut steps = Vec::new();
        for layer in layers {
            let lane = *lanes.entry((link.net, is_back, layer)).or_insert_with(|| {
                self.nodes.push(Item {
                    layer,
                    height: self.gaps.lane_height,
                    band: self.nodes[link.from].band,
                });
                self.is_lane.push(true);
                self.nodes.len() - 1
            });
            let side = |is_right| Side {
                node: lane,
                is_right,
                offset: half,
            };
            steps.push(Step {
                channel: layer + usize::from(is_back),
                from: begin,
                to: side(is_back),
            });
            begin = side(!is_back);
        }
        steps.push(Step {
            channel: to,
            from: begin,
            to: Side {
                node: link.to,
                is_right: false,
                offset: link.to_y,
            },
        });
        steps
    }

    fn y(&self, side: &Side) -> f64 {
        self.tops[side.node] + side.offset
    }

    /// Improves layer by layer: from the left by what is before each, or from the right by all that is around it.
    fn sweep(&mut self, from_left: bool) {
        let count = self.layers.len();
        for at in 0..count {
            let layer = if from_left { at } else { count - 1 - at };
            self.improve(layer, from_left && layer > 0);
        }
    }

    /// Moves the nodes of a layer to where their links lead: to layers before it alone, or to all.
    fn improve(&mut self, layer: usize, before_only: bool) {
        let wanted = self.wanted(layer, before_only);
        self.settle(layer, |node| wanted.get(&node).copied());
    }

    /// Where the links of a layer's nodes lead: the mean, and how many there are.
    fn wanted(&self, layer: usize, before_only: bool) -> BTreeMap<usize, (f64, f64)> {
        let mut wanted: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        for step in self.steps.iter().flatten() {
            for (own, other) in [(step.from, step.to), (step.to, step.from)] {
                let [here, there] = [own, other].map(|side| self.nodes[side.node].layer);
                if here == layer && (there <= layer || !before_only) {
                    let (sum, weight) = wanted.entry(own.node).or_default();
                    *sum += self.y(&other) - own.offset;
                    *weight += 1.0;
                }
            }
        }
        wanted.values_mut().for_each(|(sum, weight)| *sum /= *weight);
        wanted
    }

    /// Takes every change of places that makes links shorter and has them cross no more often.
    ///
    /// Of very large graphs the places stay as they are: each change would cost as much as all links.
    fn shorten(&mut self) {
        if self.nodes.len() > MOST_SHORTENED {
            return;
        }
        let mut cost = self.cost();
        for _ in 0..SWEEPS {
            for layer in 0..self.layers.len() {
                for before_only in [false, true] {
                    let (tops, order) = (self.tops.clone(), self.layers[layer].clone());
                    self.improve(layer, before_only);
                    let now = self.cost();
                    if now < cost {
                        cost = now;
                    } else {
                        (self.tops, self.layers[layer]) = (tops, order);
                    }
                }
                for place in 0..self.layers[layer].len() {
                    let node = self.layers[layer][place];
                    let before = self.tops[node];
                    self.tops[node] = self.moved(layer, place);
                    let now = self.cost();
                    if now < cost {
                        cost = now;
                    } else {
                        self.tops[node] = before;
                    }
                }
            }
        }
    }

    /// Where a node of a layer is nearest to where its links lead, while its neighbours stay.
    fn moved(&self, layer: usize, place: usize) -> f64 {
        let nodes = &self.layers[layer];
        let node = nodes[place];
        let above = place.checked_sub(1).map(|above| nodes[above]);
        let below = nodes.get(place + 1).copied();
        let least = above.map(|above| self.tops[above] + self.nodes[above].height + self.gap(above, node));
        let most = below.map(|below| self.tops[below] - self.gap(node, below) - self.nodes[node].height);
        let wish = self
            .wanted(layer, false)
            .get(&node)
            .map_or(self.tops[node], |(wish, _)| wish.round());
        let [low, high] = self.limits[self.nodes[node].band];
        let wish = wish.min(high - self.nodes[node].height);
        let wish = most.map_or(wish, |most| wish.min(most));
        least.map_or(wish, |least| wish.max(least)).max(low)
    }

    /// Orders each band of a layer by where its nodes want their tops to be, and puts them as near as they may be.
    fn settle(&mut self, layer: usize, wanted: impl Fn(usize) -> Option<(f64, f64)>) {
        let mut nodes = std::mem::take(&mut self.layers[layer]);
        let wish = |node: usize| wanted(node).unwrap_or((self.tops[node], 0.1));
        let middle = |node: &usize| wish(*node).0 + self.nodes[*node].height / 2.0;
        let band = |node: &usize| self.nodes[*node].band;
        nodes.sort_by(|a, b| {
            let by_wish = middle(a).total_cmp(&middle(b)).then(a.cmp(b));
            band(a).cmp(&band(b)).then(by_wish)
        });
        let places: Vec<f64> = nodes
            .chunk_by(|a, b| band(a) == band(b))
            .flat_map(|of_band| self.settled(of_band, &wish))
            .collect();
        for (node, place) in nodes.iter().zip(places) {
            self.tops[*node] = place;
        }
        self.layers[layer] = nodes;
    }

    /// Where the tops of a band's nodes are in their order, as near to what they want as they may be.
    fn settled(&self, nodes: &[usize], wish: &impl Fn(usize) -> (f64, f64)) -> Vec<f64> {
        let mut offsets = Vec::with_capacity(nodes.len());
        let mut below = 0.0;
        for (at, node) in nodes.iter().enumerate() {
            if at > 0 {
                below += self.gap(nodes[at - 1], *node);
            }
            offsets.push(below);
            below += self.nodes[*node].height;
        }
        let wishes = nodes.iter().zip(&offsets).map(|(node, offset)| {
            let (top, weight) = wish(*node);
            (top - offset, weight)
        });
        let [low, high] = self.limits[self.nodes[nodes[0]].band];
        let places = rising(wishes).into_iter().zip(&offsets);
        places
            .map(|(place, offset)| place.round().min(high - below).max(low) + offset)
            .collect()
    }

    fn gap(&self, above: usize, below: usize) -> f64 {
        match self.is_lane[above] && self.is_lane[below] {
            true => self.gaps.lane,
            false => self.gaps.item,
        }
    }

    /// How often links cross in channels, and how far they climb.
    fn cost(&self) -> (usize, i64) {
        let steps: Vec<&Step> = self.steps.iter().flatten().collect();
        let ends = |step: &Step| {
            let [from, to] = [self.y(&step.from), self.y(&step.to)];
            if step.from.is_right { [from, to] } else { [to, from] }
        };
        let mut crossings = 0;
        for (at, one) in steps.iter().enumerate() {
            for other in steps[at + 1..].iter().filter(|other| other.channel == one.channel) {
                let ([a, b], [c, d]) = (ends(one), ends(other));
                crossings += usize::from((a - c) * (b - d) < 0.0);
            }
        }
        let climbed = steps.iter().map(|step| (self.y(&step.from) - self.y(&step.to)).abs());
        (crossings, climbed.sum::<f64>().round() as i64)
    }

    /// Top and bottom of a band.
    fn extent(&self, band: usize) -> Option<[f64; 2]> {
        let members = (0..self.nodes.len()).filter(|node| self.nodes[*node].band == band);
        let rows = members.map(|node| [self.tops[node], self.tops[node] + self.nodes[node].height]);
        rows.reduce(|[top, bottom], [from, to]| [top.min(from), bottom.max(to)])
    }

    fn arranged(mut self, items: usize) -> Arranged {
        let top = self.tops.iter().copied().fold(f64::INFINITY, f64::min);
        self.tops.iter_mut().for_each(|place| *place -= top);
        let bottoms = self.tops.iter().zip(&self.nodes).map(|(top, node)| top + node.height);
        let height = bottoms.fold(0.0, f64::max);
        let bands = (0..self.limits.len()).map(|band| self.extent(band)).collect();
        let at = |side: &Side| At {
            // The right side of a node is the left side of the channel behind it.
            is_right: !side.is_right,
            y: self.y(side),
        };
        let hop = |step: &Step| Hop {
            channel: step.channel,
            from: at(&step.from),
            to: at(&step.to),
        };
        Arranged {
            bands,
            tops: self.tops[..items].to_vec(),
            routes: self.steps.iter().map(|steps| steps.iter().map(hop).collect()).collect(),
            height,
        }
    }
}

/// The numbers that rise nowhere below the one before and are nearest to wishes with weights.
fn rising(wishes: impl Iterator<Item = (f64, f64)>) -> Vec<f64> {
    // Neighbours that would fall become one pool at their mean.
    let mut pools: Vec<(f64, f64, usize)> = Vec::new();
    for (wish, weight) in wishes {
        let mut pool = (wish, weight, 1);
        while let Some(last) = pools.last().filter(|last| last.0 > pool.0) {
            let weight = last.1 + pool.1;
            pool = ((last.0 * last.1 + pool.0 * pool.1) / weight, weight, last.2 + pool.2);
            pools.pop();
        }
        pools.push(pool);
    }
    let each = pools
        .into_iter()
        .flat_map(|(mean, _, count)| std::iter::repeat_n(mean, count));
    each.collect()
}
