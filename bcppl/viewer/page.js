// The page: its state is a step, a particle (none: the mean) and a moment of the step's touch.

const element = (name) => document.getElementById(name);
const held = unpacked(JSON.parse(element("data").textContent));
element("data").remove();
const { part, peg, palette } = held, labels = [], steps = [];
held.measurements = []; // one fewer than steps, for the first is the prior
const state = { step: 0, particle: null, moment: null };
const scene = new Scene(element("scene"), element("overlay"));
const extent = part.extent, AXES = [["x", palette.x], ["y", palette.y], ["z", palette.z]];

const middle = [0, 1, 2].map((k) => {
  const [low, high] = bounds(part.vertices.filter((_, n) => n % 3 === k));
  return 0.5 * (low + high);
});
const reach = Number((0.9 * extent).toPrecision(1)); // of the world's axes, a round number
let hardest = 1; // N
const arrow = 0.45 * extent; // as in the figures: the part's z axis, and a tick along its x

const shapes = {
  part: scene.geometry(part.vertices, part.faces),
  edges: scene.geometry(part.edges),
  outline: scene.geometry(part.edges.subarray(0, 6 * 60)),
  arrow: scene.geometry([0, 0, 0, 0, 0, arrow, 0, 0, 0, 0.3 * arrow, 0, 0]),
  peg: peg && scene.geometry(peg.vertices, peg.faces),
  pegEdges: peg && scene.geometry(peg.edges),
  dot: scene.geometry(scaled(DOT, 0.012 * extent), DOT_FACES),
  finger: scene.geometry(scaled(DOT, 0.035 * extent), DOT_FACES),
  links: held.arm ? held.arm.links.map((each) => scene.geometry(each.vertices, each.faces)) : [],
};

// A step after those that are there.
function append({ label, step, measurement, cells }) {
  const k = labels.push(label) - 1;
  steps.push(step);
  if (measurement) held.measurements.push(measurement);
  if (measurement && measurement.force) hardest = bounds([hardest, ...listed(measurement.force).map((each) => Math.hypot(...each))])[1];
  if (cells.length) document.querySelector("tbody").appendChild(line("td", cells)).onclick = () => toStep(k);
}

// The newest measurement up to a step that has something.
function newest(step, name) {
  for (let k = step - 1; k >= 0; k--) if (held.measurements[k][name]) return k;
  return -1;
}

function chosenPose() {
  const step = steps[state.step];
  return state.particle === null ? Array.from(step.mean) : Array.from(row(step.poses, state.particle));
}

// Where the peg, or the finger, has met the part so far, and the touch of this step.
function drawTouch(touch) {
  const felt = held.measurements.slice(0, state.step).filter((each) => each.tip && each !== touch);
  const met = (each, opacity) => listed(each.tip).filter((_, k) => each.felt[k]).map((at) => [[...at, 1, 0, 0, 0], palette.felt, opacity]);
  scene.put(shapes.dot, felt.flatMap((each) => met(each, 0.35)));
  if (!touch) return;
  const tip = listed(touch.tip), at = tip[state.moment], pose = Array.from(row(touch.pose, state.moment));
  scene.put(shapes.dot, met(touch, 1));
  scene.put(scene.geometry(segments(tip)), [[IDENTITY, palette.seen, 1]]);
  if (touch.command) scene.put(scene.geometry(segments(listed(touch.command))), [[IDENTITY, palette.particle, 0.6]]);
  if (touch.body === "peg" && peg) {
    scene.put(shapes.peg, [[pose, palette.peg, 1]]);
    scene.put(shapes.pegEdges, [[pose, "#333333", 1]]);
  } else scene.put(shapes.finger, [[pose, palette.peg, 1]]);
  const force = Array.from(row(touch.force, state.moment));
  const size = Math.hypot(...force);
  if (size < 0.05) return;
  const along = touch.body === "peg" ? turned(pose, force) : force;
  const end = at.map((each, k) => each + (0.8 * extent * along[k]) / hardest);
  scene.put(scene.geometry([...at, ...end]), [[IDENTITY, palette.felt, 1]]);
  scene.labels.push({ at: end, text: `${number(size)} N`, colour: "#7a2f5a" });
}

// Links where they were at this moment of the touch, between the rows at which they are known.
function drawArm({ arm }) {
  if (!arm || !element("arm").checked) return 0;
  const { rows, poses } = arm;
  let k = 0;
  while (k < rows.length - 2 && rows[k + 1] <= state.moment) k++;
  const next = Math.min(k + 1, rows.length - 1), share = (state.moment - rows[k]) / (rows[next] - rows[k] || 1);
  const at = (n, link) => Array.from(row(poses, n).subarray(7 * link, 7 * link + 7));
  shapes.links.forEach((link, n) => scene.put(link, [[between(at(k, n), at(next, n), share), palette.arm, 1]]));
  return shapes.links.length;
}

// The frustum of a camera from its centre to a distance.
function frustum(camera, far) {
  const corner = (u, v) => [((u - camera.cx) / camera.fx) * far, ((v - camera.cy) / camera.fy) * far, far];
  const [right, low] = [camera.width - 0.5, camera.height - 0.5];
  const corners = [corner(-0.5, -0.5), corner(right, -0.5), corner(right, low), corner(-0.5, low)];
  return corners.flatMap((each, k) => [0, 0, 0, ...each, ...each, ...corners[(k + 1) % 4]]);
}

function drawCameras() {
  const drawn = new Set();
  held.measurements.forEach(({ camera }, k) => {
    if (!camera || drawn.has(camera.name)) return;
    drawn.add(camera.name);
    const now = held.measurements[state.step - 1]?.camera?.name === camera.name;
    const pose = Array.from(camera.pose);
    scene.put(scene.geometry(frustum(camera, extent)), [[pose, now ? palette.strong : "#555555", 1]]);
    scene.labels.push({ at: pose.slice(0, 3), text: camera.name, colour: now ? palette.strong : "#555555" });
  });
}

function drawSpace(touch) {
  const step = steps[state.step], mean = Array.from(step.mean), chosen = chosenPose();
  [scene.things, scene.labels] = [[], []];
  ["x", "y", "z"].forEach((name, k) => {
    const end = [0, 1, 2].map((n) => mean[n] + (n === k ? reach : 0));
    scene.put(scene.geometry([...mean.slice(0, 3), ...end]), [[IDENTITY, palette.body, 1]]);
    scene.labels.push({ at: end, text: `world ${name}${k ? "" : `, ${number(1e3 * reach)} mm`}`, colour: "#777777" });
  });
  drawCameras();
  document.documentElement.dataset.arm = touch ? drawArm(touch) : 0;
  drawTouch(touch);
  if (held.truth) scene.put(shapes.edges, [[Array.from(held.truth), palette.truth, 1]]);
  scene.put(shapes.edges, [[mean, "#333333", 1]]);
  const heaviest = bounds(step.weights)[1], crowd = Math.min(1, 8 / Math.sqrt(step.ess || 1));
  const cloud = listed(step.poses).map((pose, k) => [pose, palette.cloud, Math.max(0.02, crowd * (step.weights[k] / heaviest))]);
  scene.put(element("outlines").checked ? shapes.outline : shapes.arrow, cloud);
  if (state.particle !== null) {
    scene.put(shapes.edges, [[chosen, palette.strong, 1]]);
    scene.put(shapes.part, [[chosen, palette.strong, 0.45]]);
    scene.put(shapes.arrow, [[chosen, palette.strong, 1]]);
  }
  scene.put(shapes.part, [[mean, palette.body, state.particle === null ? 0.4 : 0.2]]);
  if (touch && touch.witness) {
    const witness = placed(chosen, Array.from(row(touch.witness, state.particle === null ? 0 : state.particle + 1)));
    scene.put(shapes.dot, [[[...witness, 1, 0, 0, 0], palette.strong, 1]]);
  }
  scene.draw();
}

function drawDepth(words) {
  const index = newest(state.step, "depth"), image = held.measurements[index];
  element("images").hidden = element("scales").hidden = !image;
  element("image_of").textContent = image
    ? `Depth of ${image.camera.name}, ${labels[index + 1]}${image.step > 1 ? `, every ${image.step}. pixel` : ""}:`
    : held.measurements.some((each) => each.depth) ? "No depth image yet." : "";
  if (!image) return delete document.documentElement.dataset.depth;
  const { camera } = image, seen = measuredDepth(image), depth = rendered(part, camera, chosenPose());
  const off = seen.map((each, k) => 1e3 * (each - depth[k]));
  const known = depth.filter((each) => !Number.isNaN(each));
  // In the greys of depths about the part, for a wall behind it would take them all.
  const [nearest, farthest] = known.length ? bounds(known) : [image.low, image.high];
  const [low, high] = [nearest - 0.4 * extent, farthest + 0.8 * extent];
  const frame = element("whole").checked ? null : surrounding(depth, camera);
  paint(element("measured"), camera, frame, seen, GREYS, low, high, [240, 228, 66]);
  paint(element("rendered"), camera, frame, depth, GREYS, low, high, [255, 255, 255]);
  paint(element("difference"), camera, frame, off, BLUE_TO_RED, -10, 10, [255, 255, 255]);
  element("rendered_at").textContent = `rendered at ${chosenName()}`;
  element("scales").textContent = `Light is near, dark is far: ${number(1e3 * low)} to ${number(1e3 * high)} mm; yellow is missing. `
    + "Difference: blue is 10 mm nearer than rendered, red 10 mm farther, light agrees.";
  const count = off.filter((each) => !Number.isNaN(each)).length;
  words.push(count ? `measured − rendered depth: median ${number(median(off))} mm over ${count} pixels` : "no pixel sees the part");
  document.documentElement.dataset.depth = known.length;
}

function chosenName() {
  return state.particle === null ? (steps[state.step].particles ? "the mean" : "the guess") : `particle ${steps[state.step].numbers[state.particle]}`;
}

function drawTouchPlots(touch, words) {
  const own = newest(state.step, "times");
  const of = own < 0 ? null : held.measurements[own].of;
  const whole = held.measurements.filter((each) => each.times && each.of === of);
  const axes = own < 0 ? "" : `, along ${held.measurements[own].axes}`;
  const bands = [];
  if (touch) bands.push([touch.times[0], touch.times[touch.times.length - 1], palette.seen, 0.1]);
  for (const each of whole) {
    each.felt.forEach((felt, k) => {
      if (felt) bands.push([each.times[Math.max(0, k - 1)], each.times[k], palette.felt, 0.25]);
    });
  }
  const cursor = touch ? touch.times[state.moment] : null;
  const all = (name, k) => whole.flatMap((each) => Array.from(each[name]).filter((_, n) => n % 3 === k));
  const times = whole.flatMap((each) => Array.from(each.times));
  const curves = (name) => AXES.map(([axis, colour], k) => ({ x: times, y: all(name, k), colour, name: axis }));
  const at = [plot(element("force"), `force (N)${axes}`, whole.length ? curves("force") : [], { bands, cursor })];
  at.push(plot(element("torque"), `torque (N m)${axes}`, whole.length ? curves("torque") : [], { bands, cursor }));
  const gaps = (k) => Array.from(row(touch.gap, k), (each) => 1e3 * held.gap_unit * each);
  const shown = [];
  if (touch && touch.gap) {
    const x = Array.from(touch.gap_rows, (each) => touch.times[each]);
    const which = state.particle === null ? 0 : state.particle + 1;
    shown.push({ x, y: gaps(0), colour: "#333333", name: steps[state.step].particles ? "mean" : "guess" });
    if (which) shown.push({ x, y: gaps(which), colour: palette.strong, name: "particle", width: 2 });
    const firm = gaps(which)[touch.firmest], felt = touch.felt[touch.gap_rows[touch.firmest]];
    const beyond = Math.abs(row(touch.gap, which)[touch.firmest]) === 32767 ? "of more than " : "";
    words.push(`gap ${beyond}${number(firm)} mm where most was felt${felt ? " (contact: 0 mm)" : ", which is no contact"}`);
  }
  const inTouch = touch ? bands.filter(([from]) => from >= touch.times[0]).slice(1).filter(([, to]) => to <= touch.times[touch.times.length - 1]) : [];
  at.push(plot(element("gap"), `gap between ${touch ? touch.body : "peg"} and part (mm)`, shown, { bands: inTouch, cursor }));
  ["force", "torque", "gap"].forEach((name, k) => {
    element(name).onclick = (event) => at[k] && touch && toMoment(touch, at[k](event.offsetX));
  });
}

function toMoment(touch, time) {
  let best = 0;
  touch.times.forEach((each, k) => (best = Math.abs(each - time) < Math.abs(touch.times[best] - time) ? k : best));
  state.moment = best;
  update();
}

function offset(a, b) {
  const apart = 1e3 * Math.hypot(...minus(a, b));
  const dot = Math.abs([3, 4, 5, 6].reduce((sum, k) => sum + a[k] * b[k], 0));
  return `${number(apart)} mm and ${number((360 / Math.PI) * Math.acos(Math.min(1, dot)))}°`;
}

function update() {
  const step = steps[state.step], current = held.measurements[state.step - 1];
  const touch = current && current.times ? current : null;
  if (state.particle !== null && state.particle >= step.weights.length) state.particle = null;
  if (touch && (state.moment === null || state.moment >= touch.times.length)) {
    state.moment = touch.gap ? touch.gap_rows[touch.firmest] : touch.times.length - 1;
  }
  const words = [];
  drawDepth(words);
  drawTouchPlots(touch, words);
  drawSpace(touch);
  const crowd = step.weights.length < step.particles ? `, the ${step.weights.length} heaviest are drawn` : "";
  const inferred = step.particles
    ? `: ${step.particles} particles${crowd}, ESS ${number(step.ess)}, ± ${number(step.spread_mm)} mm, ± ${number(step.spread_degrees)}°` : "";
  element("step").value = state.step;
  element("label").textContent = `${labels[state.step]} (${state.step} of ${labels.length - 1})${inferred}`;
  element("particle").value = state.particle === null ? "" : step.numbers[state.particle];
  const pose = chosenPose(), mean = Array.from(step.mean);
  if (state.particle !== null) words.unshift(`weight ${number(100 * step.weights[state.particle])} %, ${offset(pose, mean)} from the mean`);
  else if (held.truth) words.unshift(`${offset(pose, Array.from(held.truth))} from the truth`);
  if (held.arm && touch && !touch.arm) words.push(`${held.arm.name} does not reach the peg's poses`);
  element("chosen").textContent = `${chosenName()}: ${words.join("; ")}`;
  element("moments").hidden = !touch;
  if (touch) {
    [element("moment").max, element("moment").value] = [touch.times.length - 1, state.moment];
    element("time").textContent = `${touch.times[state.moment].toFixed(3)} s`;
  }
  [...document.querySelectorAll("tbody tr")].forEach((line, k) => line.classList.toggle("now", k === state.step));
  const now = document.querySelector("tr.now"), table = element("table");
  if (now) table.scrollTop = now.offsetTop - 0.5 * table.clientHeight;
  Object.assign(document.documentElement.dataset, {
    step: state.step, label: labels[state.step], particles: step.weights.length, chosen: state.particle ?? "mean",
    triangles: part.faces.length / 3, cameras: scene.labels.length, gl: Boolean(scene.gl), peg: Boolean(touch),
  });
}

function toStep(step) {
  state.step = Math.max(0, Math.min(labels.length - 1, step));
  state.moment = null;
  update();
}

function toNumber(number) {
  const numbers = Array.from(steps[state.step].numbers || []);
  state.particle = numbers.includes(number) ? numbers.indexOf(number) : null;
  update();
}

// The particle whose arrow begins nearest to a click, within 15 pixels; the heavier of two that are as near.
scene.picked = ([x, y]) => {
  const matrix = scene.matrix(), { poses, weights } = steps[state.step];
  const far = listed(poses).map((pose, k) => {
    const ends = [placed(pose, [0, 0, 0]), placed(pose, [0, 0, arrow])].map((end) => scene.project(end, matrix));
    const away = Math.min(...ends.map((at) => (at ? Math.hypot(at[0] - x, at[1] - y) : Infinity)));
    return Math.round(away) - weights[k];
  });
  const best = far.indexOf(bounds(far)[0]);
  state.particle = best >= 0 && far[best] < 15 ? best : null;
  update();
};

// State that a link gives: #step=3&particle=17.
function fromLink() {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.has("step")) toStep(Number(given.get("step")) || 0);
  if (given.has("particle")) toNumber(Number(given.get("particle")));
  if (given.has("step") && !held.arm) toward(scene.distance);
}

function toward(distance) {
  [scene.target, scene.distance] = [placed(Array.from(steps[state.step].mean), middle), distance];
  scene.draw();
}

// The part, the cameras and the arm's links about the middle of the picture.
function overview() {
  const links = (arm) => shapes.links.map((_, k) => arm.poses.subarray(7 * k, 7 * k + 7));
  const at = held.measurements.flatMap(({ camera, arm }) => [...(camera ? [camera.pose] : []), ...(arm ? links(arm) : [])]);
  const ends = [0, 1, 2].map((k) => bounds([steps[state.step].mean, ...at].map((each) => each[k])));
  scene.target = ends.map(([low, high]) => 0.5 * (low + high));
  scene.distance = Math.max(4.5 * extent, 1.8 * Math.hypot(...ends.map(([low, high]) => high - low)));
  scene.draw();
}

function line(tag, cells) {
  const made = document.createElement("tr");
  for (const each of cells) made.appendChild(document.createElement(tag)).textContent = each;
  return made;
}

function keys() {
  const shown = [[palette.body, `${part.name} at ${held.inferred ? "the mean" : "its guess"}`]];
  if (held.inferred) shown.push([palette.cloud, "particles, darker is heavier"], [palette.strong, "chosen particle"]);
  if (held.truth) shown.push([palette.truth, "truth"]);
  if (held.measurements.some((each) => each.times)) {
    shown.push([palette.peg, peg ? peg.name : "finger"], [palette.seen, "path of its tip"], [palette.felt, "contact felt, force"]);
    if (held.measurements.some((each) => each.command)) shown.push([palette.particle, "path as commanded"]);
  }
  if (held.arm) shown.push([palette.arm, `${held.arm.name}, by inverse kinematics`]);
  element("keys").replaceChildren();
  for (const [colour, name] of shown) {
    const key = element("keys").appendChild(document.createElement("span"));
    key.className = "key";
    key.appendChild(document.createElement("span")).className = "swatch";
    key.firstChild.style.background = colour;
    key.append(name);
  }
}

element("facts").textContent = held.facts.map((pair) => pair.join(" ")).join(", ");
element("notes").textContent = [...held.notes, ...(scene.gl ? [] : ["This browser has no WebGL 2: nothing is drawn in space."])].join(" ");
element("source").textContent = held.source;
document.querySelector("thead").append(line("th", held.columns));
held.entries.forEach(append);
state.step = labels.length - 1;
element("table").hidden = !held.columns.length;
element("arms").hidden = !held.arm;
for (const name of ["particle", "mean", "outlines"]) element(name).disabled = !held.inferred;
keys();
element("step").max = labels.length - 1;
element("step").oninput = (event) => toStep(Number(event.target.value));
element("back").onclick = () => toStep(state.step - 1);
element("forth").onclick = () => toStep(state.step + 1);
element("mean").onclick = () => toNumber(-1);
element("particle").onchange = (event) => toNumber(event.target.value === "" ? -1 : Number(event.target.value));
element("moment").oninput = (event) => { state.moment = Number(event.target.value); update(); };
element("outlines").onchange = element("whole").onchange = element("arm").onchange = update;
element("near").onclick = () => toward(4.5 * extent);
element("far").onclick = overview;
window.addEventListener("resize", update);
window.addEventListener("hashchange", fromLink);
toward(4.5 * extent);
if (held.arm) overview();
update();
fromLink();
document.documentElement.dataset.milliseconds = Math.round(performance.now()); // since the page was asked for
