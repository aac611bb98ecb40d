//! Candle's networks and the kernels of `realo_kernels` agree: every model that ships, on a small map.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::canvas::Canvas;
use realo_kernels::conv::Pool;
use realo_kernels::warp::Warp;
use realo_methods::candle::{Copier, Elements, Engine, Error, Network, Watch};
use realo_methods::network::{self, NetworkOptions};
use realo_methods::tensors::{self, AgentMap, Placed, Tensors};
use realo_methods::v2xvit::{Settings, Window};
use realo_methods::{Model, attfuse};
use realo_nn::filler::{Numbers, weights};
use realo_nn::layers::Layers;
use realo_nn::model::{Precision, Sharing};
use realo_nn::weights::Weights;

/// Numbers of a result that sums in another order, of some dozen layers, may give: f32 is exact to 6e-8.
const TOLERANCE: f32 = 1e-5;

/// The models that ship, on maps of 16 x 32 cells.
fn models() -> Vec<Model> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = files
        .filter(|path| path.extension().is_some_and(|end| end == "toml"))
        .filter(|path| !path.to_string_lossy().ends_with(".recipe.toml"))
        .collect();
    files.sort();
    let small = |path: &std::path::PathBuf| {
        let mut model = Model::read(path).unwrap();
        (model.grid.x, model.grid.y) = ([0.0, 25.6], [0.0, 12.8]);
        model.validate().unwrap();
        model
    };
    files.iter().map(small).collect()
}

/// A transformer of several rounds and blocks on a map of 8 x 16 cells, with sizes that are no powers of two.
fn deep() -> Model {
    let mut model = models().into_iter().find(|model| model.name == "lite-v2xvit").unwrap();
    (model.grid.x, model.grid.y) = ([0.0, 12.8], [0.0, 6.4]);
    model.shrink[0].channels = 12;
    let window = |side, heads, head_width| Window {
        side,
        heads,
        head_width,
    };
    model.arch = Settings {
        depth: 2,
        blocks: 2,
        heads: 3,
        head_width: 4,
        windows: vec![window(2, 2, 3), window(4, 1, 5)],
        feed_forward: 7,
        delays: 20,
        ..Settings::default()
    }
    .into();
    model.validate().unwrap();
    model
}

fn kernels(model: &Model) -> network::Network {
    let options = NetworkOptions {
        precision: Some(Precision::F32),
        ..NetworkOptions::default()
    };
    network::Network::new(model, &weights(model, 7), options).unwrap()
}

fn map(seed: u64, [rows, columns, channels]: [usize; 3]) -> BevMap {
    let data = Numbers::new(seed).list(rows * columns * channels);
    BevMap {
        rows,
        columns,
        channels,
        data,
    }
}

/// A canvas with something in every third cell.
fn canvas(layers: &Layers) -> Canvas {
    let [rows, columns, channels] = layers.size(layers.canvas);
    let (mut canvas, mut numbers) = (Canvas::new(rows, columns, channels), Numbers::new(9));
    for cell in (0..rows * columns).step_by(3) {
        let features = numbers.list(channels);
        canvas
            .cell_mut(cell / columns, cell % columns)
            .copy_from_slice(&features);
    }
    canvas
}

/// An ego and others, turned, moved and late; the last one's map covers nothing.
fn crowd(maps: &[BevMap]) -> Vec<Agent<'_>> {
    let moved = |x, y| Warp([[0.9, 0.2, x], [-0.2, 0.9, y]]);
    let places = [
        (Warp::IDENTITY, true, 0),
        (moved(1.3, -0.4), false, 2),
        (moved(-7.0, 3.25), true, 1),
        (moved(500.0, 0.0), false, 99),
    ];
    let agent = |(map, (warp, roadside, delay))| Agent {
        warp,
        roadside,
        delay,
        ..Agent::beside(map)
    };
    maps.iter().zip(places).map(agent).collect()
}

fn assert_near(found: &[f32], expected: &[f32], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let size = expected.iter().fold(0.0f32, |size, value| size.max(value.abs()));
    let apart = found
        .iter()
        .zip(expected)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(
        size > 0.01 && apart <= TOLERANCE * size,
        "{what}: {apart} apart of {size}"
    );
}

fn numbers(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().and_then(|all| all.to_vec1()).unwrap()
}

/// What both make of the same canvas, and of the maps of several agents.
fn assert_networks_agree(model: &Model) -> Result<(), Error> {
    let layers = Layers::of(model);
    let (mut kernels, weights) = (kernels(model), weights(model, 7));
    let network = Network::new(model, &weights, &Device::Cpu, DType::F32)?;
    let canvas = canvas(&layers);
    let encoded = network.encode(&network.put_canvas(&canvas)?)?;
    let expected = kernels.encode(&canvas).unwrap();
    assert_near(&numbers(&encoded), &expected.data, &format!("{}: encode", model.name));

    let fused = map(5, layers.size(layers.fused));
    let heads = numbers(&network.heads(&network.put_fused((&fused).into())?)?);
    let expected = kernels.heads(&fused).unwrap();
    let scores = expected.scores.chunks_exact(network.scores());
    let deltas = expected
        .deltas
        .chunks_exact(heads.len() / scores.len() - network.scores());
    let expected: Vec<f32> = scores.zip(deltas).flat_map(|(a, b)| [a, b].concat()).collect();
    assert_near(&heads, &expected, &format!("{}: heads", model.name));

    let kept = network.encode_own(&network.put_canvas(&canvas)?)?;
    let expected = kernels.encode_own(&canvas).unwrap();
    assert_near(&numbers(&kept), &expected.data, &format!("{}: own map", model.name));
    let compressed = kernels.share(&expected).unwrap();
    assert_eq!(compressed.is_some(), network.shares_another(), "{}", model.name);
    if let Some(compressed) = compressed {
        let found = network.share(&kept)?;
        assert_near(&numbers(&found), &compressed.data, &format!("{}: shared", model.name));
    }

    let sizes = [layers.kept, layers.features, layers.features, layers.features].map(|of| layers.size(of));
    let maps = [0, 1, 2, 3].map(|place| map(place as u64 + 1, sizes[place]));
    let shared = network.put_shared((&maps[0]).into())?;
    let confidence = kernels.confidence(&maps[0]).unwrap();
    assert!(confidence.iter().all(|confidence| (0.0..=1.0).contains(confidence)));
    assert_near(
        &numbers(&network.confidence(&shared)?),
        &confidence,
        &format!("{}: confidence", model.name),
    );
    // Every third cell is not there.
    let some: Vec<f32> = (0..confidence.len()).map(|cell| (cell % 3) as f32).collect();
    for count in (1..=4).filter(|_| model.arch.fuses()) {
        for sparse in [false, true] {
            let mut agents = crowd(&maps[..count]);
            for agent in agents[1..].iter_mut().filter(|_| sparse) {
                agent.confidence = Some(&some);
            }
            let found = network.fuse(&network.put_agents(&agents)?)?;
            let expected = kernels.fuse(&agents).unwrap();
            let what = format!("{}: fusion of {count}, sparse: {sparse}", model.name);
            assert_near(&numbers(&found), &expected.data, &what);
        }
    }
    Ok(())
}

#[test]
fn all_models_agree() -> Result<(), Error> {
    let models = models();
    assert!(models.len() >= 11, "the models that ship");
    models.iter().try_for_each(assert_networks_agree)
}

#[test]
fn compressed_maps_are_restored_before_they_are_fused() -> Result<(), Error> {
    for mut model in models().into_iter().filter(|model| model.name.starts_with("lite")) {
        if model.arch.fuses() {
            model.arch.set_compression(8);
            assert_networks_agree(&model)?;
        }
    }
    Ok(())
}

#[test]
fn an_ego_that_keeps_its_own_map_whole_fuses_it_with_restored_ones() -> Result<(), Error> {
    let mut models = models().into_iter();
    let mut model = models.find(|model| model.name == "lite-attfuse").expect("it ships");
    model.arch = attfuse::Settings(Sharing {
        compression: 8,
        compress_own: false,
        ..Sharing::default()
    })
    .into();
    assert_networks_agree(&model)
}

#[test]
fn transformers_of_odd_sizes_agree() -> Result<(), Error> {
    assert_networks_agree(&deep())
}

#[test]
fn gradients_lead_through_the_transformer_to_all_weights_that_count() -> candle_core::Result<()> {
    let model = deep();
    let layers = Layers::of(&model);
    let method = model.arch.method().expect("a transformer fuses");
    let layer = layers.fusion().expect("a layer that fuses");
    let weights = weights(&model, 7);
    let keys = layers.tensors().filter(|spec| spec.key.starts_with("fusion_net"));
    let variables: HashMap<String, Var> = keys
        .map(|spec| {
            let numbers = weights.tensor(&spec.key);
            Ok((spec.key, Var::from_slice(numbers, spec.shape, &Device::Cpu)?))
        })
        .collect::<candle_core::Result<_>>()?;
    let tensors = Tensors::new(
        variables
            .iter()
            .map(|(key, var)| (key.clone(), var.as_tensor().clone()))
            .collect(),
    );
    let maps = [1, 2, 3].map(|seed| map(seed, layers.size(layers.restored)));
    let agents = crowd(&maps).into_iter().map(|agent| {
        let size = (agent.map.rows, agent.map.columns, agent.map.channels);
        let map = Tensor::from_slice(agent.map.data, size, &Device::Cpu)?;
        Ok(tensors::Agent {
            map: AgentMap::Placed(Placed::new(&map, &agent.warp, agent.confidence)?),
            roadside: agent.roadside,
            delay: agent.delay,
        })
    });
    let agents = agents.collect::<candle_core::Result<Vec<_>>>()?;
    let loss = || method.operation(layer, &tensors, &agents)?.sqr()?.sum_all();
    let gradients = loss()?.backward()?;
    for (key, variable) in &variables {
        // The last to ask is the ego alone, a roadside unit; the prior is stored and never used.
        let of_last_vehicle = || key.contains("layers.1.0.layers.1.0.fn") && key.contains("_linears.0.");
        let Some(gradient) = gradients.get(variable) else {
            assert!(key.contains("prior_feed") || of_last_vehicle(), "no gradient of {key}");
            continue;
        };
        // Along the gradient the loss grows as its length says.
        let length = gradient.sqr()?.sum_all()?.to_scalar::<f32>()?.sqrt();
        if length < 1e-3 {
            // A key's bias changes all scores alike, and no weight.
            assert!(key.contains("k_linears") && key.ends_with("bias"), "{key}: {length}");
            continue;
        }
        let before = variable.as_tensor().copy()?;
        let step = 1e-3 * (1.0 + before.sqr()?.sum_all()?.to_scalar::<f32>()?.sqrt());
        let along = (gradient * f64::from(step / length))?;
        let at = |sign: f64| -> candle_core::Result<f64> {
            variable.set(&(&before + (&along * sign)?)?)?;
            Ok(f64::from(loss()?.to_scalar::<f32>()?))
        };
        let grown = (at(1.0)? - at(-1.0)?) / (2.0 * f64::from(step));
        variable.set(&before)?;
        let apart = (grown - f64::from(length)).abs();
        assert!(
            apart < 0.05 * f64::from(length) + 0.5,
            "{key}: grows by {grown}, gradient {length}"
        );
    }
    Ok(())
}

/// Whether a method leads gradients back by kernels; they find what candle finds, with the same bits on any threads.
fn assert_gradients_agree(model: &Model) -> candle_core::Result<bool> {
    let layers = Layers::of(model);
    let method = model.arch.method().expect("it fuses");
    let (layer, weights) = (layers.fusion().expect("a layer that fuses"), weights(model, 7));
    let Some(descent) = method.descent(layer, &weights) else {
        return Ok(false);
    };
    let maps = [1, 2, 3, 4].map(|seed| map(seed, layers.size(layers.restored)));
    let along = map(9, layers.size(layers.fused)).data;
    for count in 1..=4 {
        let (agents, what) = (crowd(&maps[..count]), format!("{}, {count} agents", model.name));
        let expected = gradients_of_operation(model, &weights, &agents, &along)?;
        let [found, on_threads] = [1, 3].map(|threads| {
            let mut pool = Pool::new(threads);
            let (fused, back) = descent.run(&agents, &mut pool);
            assert_near(&fused, &expected.fused, &what);
            back(&agents, &along, &mut pool)
        });
        assert!(found == on_threads, "{what}: threads change bits");
        for (index, (found, expected)) in found.maps.iter().zip(&expected.maps).enumerate() {
            match index < 3 {
                // Sums of few terms, which rounding does not reach.
                true if layer.tensors.is_empty() => assert_near(found, expected, &format!("{what}: map {index}")),
                true => assert_near_enough(found, expected, &format!("{what}: map {index}")),
                false => assert!(found.iter().all(|number| *number == 0.0), "{what}: map {index}"),
            }
        }
        assert!(found.tensors.keys().eq(expected.tensors.keys()), "{what}");
        for (key, found) in &found.tensors {
            assert_near_enough(found, &expected.tensors[key], &format!("{what}: {key}"));
        }
    }
    Ok(true)
}

/// As [`assert_near`], of gradients, which may be 0: where their terms cancel, rounding is left.
fn assert_near_enough(found: &[f32], expected: &[f32], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let size = expected.iter().fold(0.0f32, |size, value| size.max(value.abs()));
    for (index, (found, expected)) in found.iter().zip(expected).enumerate() {
        let apart = (found - expected).abs();
        assert!(
            apart <= 2.0 * TOLERANCE * size + TOLERANCE,
            "{what}, {index}: {found}, expected {expected} of {size}"
        );
    }
}

struct OfOperation {
    fused: Vec<f32>,
    maps: Vec<Vec<f32>>,
    tensors: BTreeMap<String, Vec<f32>>,
}

/// What candle finds; the gradients are those of the products with `along`.
fn gradients_of_operation(
    model: &Model,
    weights: &Weights,
    agents: &[Agent],
    along: &[f32],
) -> candle_core::Result<OfOperation> {
    let layers = Layers::of(model);
    let method = model.arch.method().expect("it fuses");
    let layer = layers.fusion().expect("a layer that fuses");
    let variable = |numbers: &[f32], shape: &[usize]| Var::from_slice(numbers, shape, &Device::Cpu);
    let tensors = layer
        .tensors
        .iter()
        .map(|spec| Ok((spec.key.clone(), variable(weights.tensor(&spec.key), &spec.shape)?)));
    let tensors = tensors.collect::<candle_core::Result<BTreeMap<String, Var>>>()?;
    let maps = agents.iter().map(|agent| {
        let BevView {
            rows,
            columns,
            channels,
            data,
        } = agent.map;
        variable(data, &[rows, columns, channels])
    });
    let maps = maps.collect::<candle_core::Result<Vec<Var>>>()?;
    let placed = |(agent, map): (&Agent, &Var)| {
        Ok(tensors::Agent {
            map: AgentMap::Placed(Placed::new(map.as_tensor(), &agent.warp, None)?),
            roadside: agent.roadside,
            delay: agent.delay,
        })
    };
    let agents = agents.iter().zip(&maps).map(placed);
    let agents = agents.collect::<candle_core::Result<Vec<_>>>()?;
    let named = tensors.iter().map(|(key, var)| (key.clone(), var.as_tensor().clone()));
    let made = method.operation(layer, &Tensors::new(named.collect()), &agents)?;
    let gradients = (&made * Tensor::from_slice(along, made.dims(), &Device::Cpu)?)?
        .sum_all()?
        .backward()?;
    let of = |map: &Var| gradients.get(map).map_or_else(Vec::new, numbers);
    let found = tensors
        .iter()
        .filter_map(|(key, var)| Some((key.clone(), numbers(gradients.get(var)?))));
    Ok(OfOperation {
        fused: numbers(&made),
        maps: maps.iter().map(of).collect(),
        tensors: found.collect(),
    })
}

#[test]
fn kernels_lead_gradients_back_as_the_operations_do() -> candle_core::Result<()> {
    let models = models().into_iter().filter(|model| model.arch.fuses());
    let mut with_kernels = 0;
    for model in models.chain([deep()]) {
        with_kernels += usize::from(assert_gradients_agree(&model)?);
    }
    assert!(with_kernels >= 7, "{with_kernels} models have kernels of their own");
    Ok(())
}

/// Notes the steps that were done.
struct Names(Vec<&'static str>);

impl Watch for Names {
    fn step(&mut self, name: &'static str, work: &mut dyn FnMut()) {
        work();
        self.0.push(name);
    }
}

#[test]
fn an_engine_gives_what_the_kernels_give_and_times_its_steps() -> Result<(), Error> {
    let model = models().into_iter().find(|model| model.name == "lite-attfuse").unwrap();
    let (layers, weights) = (Layers::of(&model), weights(&model, 7));
    let mut kernels = kernels(&model);
    let mut engine = Engine::new(&model, &weights, &Device::Cpu, DType::F32, Elements::F32)?;
    let mut steps = Names(Vec::new());
    let named = |steps: &mut Names| std::mem::take(&mut steps.0);

    let canvas = canvas(&layers);
    let encoded = engine.encode_own(&canvas, &mut steps)?;
    let expected = ["to_device", "launch", "synchronisation", "masking", "to_host"];
    assert_eq!(named(&mut steps), expected);
    assert_near(&encoded.data, &kernels.encode(&canvas).unwrap().data, "encode");

    let other = map(2, layers.size(layers.features));
    let maps = [encoded, other];
    let agents = crowd(&maps);
    let fused = engine.fuse(&agents, &mut steps)?;
    assert_eq!(named(&mut steps), ["to_device", "launch", "synchronisation", "to_host"]);
    assert_near(&fused.data, &kernels.fuse(&agents).unwrap().data, "fuse");

    let found = engine.heads((&fused).into(), &mut steps)?;
    assert_eq!(named(&mut steps), ["to_device", "launch", "synchronisation", "to_host"]);
    let expected = kernels.heads(&fused).unwrap();
    assert_eq!((found.rows, found.columns), (expected.rows, expected.columns));
    assert_near(&found.scores, &expected.scores, "scores");
    assert_near(&found.deltas, &expected.deltas, "deltas");
    Ok(())
}

#[test]
fn what_does_not_fit_is_refused_as_the_kernels_refuse_it() -> Result<(), Error> {
    let all = models();
    let of = |name: &str| all.iter().find(|model| model.name == name).unwrap();
    let network = |name| Network::new(of(name), &weights(of(name), 7), &Device::Cpu, DType::F32);
    let fusing = network("lite-attfuse")?;
    let size = Layers::of(of("lite-attfuse")).size(Layers::of(of("lite-attfuse")).features);
    let (fitting, narrow) = (map(1, size), map(1, [size[0], size[1], 1]));
    let own = Agent::beside(&fitting);
    let error = |agents: &[Agent]| fusing.put_agents(agents).unwrap_err().to_string();
    assert!(error(&[]).contains("1 to 4 agents, the ego among them, found 0"));
    assert!(error(&[own; 5]).contains("found 5"));
    assert!(error(&[own, Agent::beside(&narrow)]).contains("x 1 channels"));
    let canvas = fusing.put_canvas(&Canvas::new(1, 2, 3)).unwrap_err().to_string();
    assert!(
        canvas.contains("the canvas has 1 rows x 2 columns x 3 channels"),
        "{canvas}"
    );
    let single = network("lite")?.put_agents(&[own]).unwrap_err().to_string();
    assert!(single.contains("fuses nothing"), "{single}");
    Ok(())
}

#[test]
fn maps_come_to_the_host_without_the_cells_that_say_nothing() -> Result<(), Error> {
    let all = models();
    let mut model = all.iter().find(|model| model.name == "lite").unwrap().clone();
    // The point in the corner is seen from 25 of 64 cells along each axis.
    (model.grid.x, model.grid.y) = ([0.0, 51.2], [0.0, 51.2]);
    let model = &model;
    let network = Network::new(model, &weights(model, 7), &Device::Cpu, DType::F32)?;
    let layers = Layers::of(model);
    let [rows, columns, channels] = layers.size(layers.canvas);
    let empty = network.encode(&network.put_canvas(&Canvas::new(rows, columns, channels))?)?;
    let mut canvas = Canvas::new(rows, columns, channels);
    canvas.cell_mut(3, 4).copy_from_slice(&Numbers::new(3).list(channels));
    let map = network.encode(&network.put_canvas(&canvas)?)?;
    let exact = numbers(&map);
    let channels = layers.size(layers.features)[2];
    let range = |channel: usize| {
        let of_channel = exact.iter().skip(channel).step_by(channels);
        of_channel.fold([f32::MAX, f32::MIN], |[min, most], v| [min.min(*v), most.max(*v)])
    };
    for (elements, width) in [(Elements::F32, 4), (Elements::F16, 2), (Elements::Int8, 1)] {
        let copier = Copier::new(elements, &empty)?;
        let of_nothing = copier.copy(&copier.take(&empty)?)?;
        assert_eq!((of_nothing.bytes, of_nothing.map.data), (0, numbers(&empty)));
        let copied = copier.copy(&copier.take(&map)?)?;
        let crossed = copied.bytes as f64 / (exact.len() * width) as f64;
        assert!((0.01..0.9).contains(&crossed), "{elements:?}: {crossed} of all cells");
        for (index, (found, exact)) in copied.map.data.iter().zip(&exact).enumerate() {
            let [min, most] = range(index % channels);
            let bound = match elements {
                Elements::F32 => 0.0,
                Elements::F16 => exact.abs() / 1024.0 + 1e-7,
                // Where both are the same code, the empty sweep's number stands for the map's.
                Elements::Int8 => (most - min) / 255.0 * 1.01,
            };
            assert!((found - exact).abs() <= bound, "{elements:?} {index}: {found}, {exact}");
        }
    }
    Ok(())
}
