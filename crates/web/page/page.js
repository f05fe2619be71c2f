// The page: chooses pictures and cameras, and draws what the library computes.
import init, { Session } from "./sigma_web.js";

/// Pixels to a side of all pictures.
const SIDE = 64;
const at = (id) => document.getElementById(id);

let session;
let samples = [];
/// The sample shown, if it is one; its pose is known.
let sample;
/// RGBA of the picture, transparent where it was.
let picture;
/// The camera of the view: 4 × 4, row by row, world_from_camera.
let camera;
/// The library does one thing at a time.
let busy = false;
/// A view is wanted as soon as it can be had.
let stale = false;

const focal = () => SIDE / 2 / Math.tan((Number(at("fov").value) * Math.PI) / 360);
const instance = () => at("object").selectedIndex;

function say(text, kind = "") {
  at("status").textContent = text;
  at("status").className = kind;
}

/// Runs `work` if the library is free.
async function alone(work) {
  if (busy || !session) return;
  busy = true;
  // Another executor is another session: not in the middle of this one's work.
  at("search").disabled = at("executor").disabled = true;
  try {
    await work();
  } catch (error) {
    say(String(error.message ?? error), "error");
    throw error;
  } finally {
    busy = false;
    at("executor").disabled = false;
    at("search").disabled = !picture;
  }
  if (stale) look();
}

function draw(id, rgba) {
  at(id).getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(rgba), SIDE, SIDE), 0, 0);
}

function show(view) {
  draw("view", view);
  if (!picture) return;
  const onWhite = (k) => 255 - ((255 - picture[k]) * picture[k | 3]) / 255;
  // White where there is none.
  const difference = view.map((value, k) => (k % 4 === 3 ? 255 : 255 - Math.min(255, 2 * Math.abs(value - onWhite(k)))));
  draw("difference", difference);
}

/// Draws the model's view from the camera.
function look() {
  stale = true;
  return alone(async () => {
    stale = false;
    show(await session.render(instance(), camera, SIDE, focal()));
  });
}

/// A camera that looks at the object's centre without roll; world z is up, the camera's y axis down.
function orbit(azimuth, elevation, distance) {
  const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
  const [right, down, forward] = [[-sa, ca, 0], [se * ca, se * sa, -ce], [-ce * ca, -ce * sa, -se]];
  const rows = [0, 1, 2].map((k) => [right[k], down[k], forward[k], -distance * forward[k]]);
  return new Float64Array([...rows.flat(), 0, 0, 0, 1]);
}

/// Azimuth, elevation and distance of a camera's place.
function place(pose) {
  const [x, y, z] = [pose[3], pose[7], pose[11]];
  const distance = Math.hypot(x, y, z);
  return [Math.atan2(y, x), Math.asin(z / distance), distance];
}

/// Angle in degrees, and distance, between two poses.
function apart(a, b) {
  let trace = 0;
  for (const k of [0, 1, 2, 4, 5, 6, 8, 9, 10]) trace += a[k] * b[k];
  const angle = (Math.acos(Math.min(1, Math.max(-1, (trace - 1) / 2))) * 180) / Math.PI;
  return [angle, Math.hypot(a[3] - b[3], a[7] - b[7], a[11] - b[11])];
}

/// Takes the middle square of an image for the picture.
async function choose(source, known) {
  const image = await createImageBitmap(source);
  const square = Math.min(image.width, image.height);
  const context = at("picture").getContext("2d", { willReadFrequently: true });
  context.clearRect(0, 0, SIDE, SIDE);
  context.imageSmoothingQuality = "high";
  context.drawImage(image, (image.width - square) / 2, (image.height - square) / 2, square, square, 0, 0, SIDE, SIDE);
  picture = context.getImageData(0, 0, SIDE, SIDE).data;
  sample = known;
  if (known) {
    at("object").value = known.object;
    at("fov").value = known.fov.toFixed(1);
  }
  for (const thumbnail of at("samples").children) thumbnail.classList.toggle("chosen", thumbnail.dataset.image === known?.image);
  at("found").textContent = at("pose").textContent = "";
  at("progress").value = 0;
  say(known?.image ?? source.name);
  at("search").disabled = busy || !session;
  await look();
}

async function chooseSample(known) {
  await choose(await (await fetch(known.image)).blob(), known);
}

/// Looks for the pose: around `rough`, or all around.
async function search(rough) {
  let found;
  await alone(async () => {
    const began = performance.now();
    const observe = (step, steps, loss) => {
      Object.assign(at("progress"), { value: step, max: steps });
      say(`step ${step} of ${steps}, loss ${loss.toPrecision(3)}`);
      // The page is drawn now: the CPU executor leaves no other time for it.
      return new Promise((go_on) => setTimeout(go_on));
    };
    // Before the first search on a GPU it is compared with the CPU.
    say("measuring kernels, comparing with the CPU");
    found = await session.estimate(instance(), new Uint8Array(picture), SIDE, focal(), rough, at("fast").checked, observe);
    camera = found.world_from_camera;
    show(found.view);
    at("progress").value = at("progress").max;
    say(`${((performance.now() - began) / 1000).toFixed(1)} s on ${session.executor()}`);
    const sure = found.rotation_deg === undefined ? "" : ` ± ${found.rotation_deg.toFixed(1)}°, ± ${found.translation.toFixed(3)}`;
    const off = sample ? apart(camera, sample.pose) : undefined;
    const truth = off ? `; the true pose is ${off[0].toFixed(2)}° and ${off[1].toFixed(3)} away` : "";
    at("found").className = found.doubt ? "doubted" : "trusted";
    at("found").textContent = (found.doubt ? `Not to be trusted: ${found.doubt}` : `Trusted${sure}`) + truth;
    const row = (k) => [...camera.slice(4 * k, 4 * k + 4)].map((value) => value.toFixed(4).padStart(8)).join(" ");
    at("pose").textContent = "world_from_camera, object units\n" + [0, 1, 2, 3].map(row).join("\n");
  });
  return found;
}

async function open() {
  const wanted = at("executor").value === "gpu";
  const object = at("object").value;
  const model = new Uint8Array(await (await fetch("model.safetensors")).arrayBuffer());
  session = undefined;
  let why = "";
  try {
    session = await Session.open(model, wanted);
  } catch (error) {
    if (!wanted) throw error;
    session = await Session.open(model, false);
    at("executor").value = "cpu";
    console.warn(error);
    why = "no WebGPU here (the console says why)";
  }
  at("object").replaceChildren(...session.instances().map((name) => new Option(name)));
  if (object) at("object").value = object;
  camera ??= orbit(0.6, 0.5, session.distance());
  at("where").textContent = why;
}

/// Dragging turns the camera about the object.
function drag() {
  let from;
  at("view").addEventListener("pointerdown", (event) => {
    from = [event.clientX, event.clientY, ...place(camera)];
    at("view").setPointerCapture(event.pointerId);
  });
  at("view").addEventListener("pointermove", (event) => {
    if (!from) return;
    const [x, y, azimuth, elevation, distance] = from;
    const most = Math.PI / 2 - 0.01;
    const up = Math.min(most, Math.max(-most, elevation + (event.clientY - y) / 100));
    camera = orbit(azimuth - (event.clientX - x) / 100, up, distance);
    look();
  });
  at("view").addEventListener("pointerup", () => (from = undefined));
}

async function main() {
  if (!("Suspending" in WebAssembly)) throw new Error("this browser cannot suspend WebAssembly (JSPI: Chrome and Edge 137, Firefox 153)");
  const [known] = await Promise.all([fetch("samples.json").then((answer) => answer.json()), init()]);
  at("fov").value = known[0].fov.toFixed(1);
  await open();
  samples = known.filter((sample) => session.instances().includes(sample.object));
  for (const sample of samples) {
    const thumbnail = Object.assign(new Image(), { src: sample.image, title: sample.image });
    thumbnail.dataset.image = sample.image;
    thumbnail.addEventListener("click", () => chooseSample(sample));
    at("samples").append(thumbnail);
  }
  at("object").addEventListener("change", look);
  at("fov").addEventListener("change", look);
  at("file").addEventListener("change", () => {
    const [file] = at("file").files;
    if (file) choose(file).catch((error) => say(`${file.name}: ${error.message}`, "error"));
  });
  at("executor").addEventListener("change", () => open().then(look));
  at("search").addEventListener("click", () => {
    const around = document.querySelector("input[name=starts]:checked").value === "around";
    search(around ? undefined : camera);
  });
  drag();
  say("choose a picture");
  await (samples.length ? chooseSample(samples[0]) : look());
}

/// For `cargo xtask web --check`: a search from 30° beside each sample's pose, told to whoever serves the page.
async function check() {
  const lines = [];
  at("fast").checked = true;
  for (const executor of ["cpu", "gpu"]) {
    at("executor").value = executor;
    await open();
    await chooseSample(samples[0]);
    const found = await search(samples[0].pose);
    const [angle, distance] = apart(found.world_from_camera, samples[0].pose);
    const seconds = at("status").textContent.split(" s on ")[0];
    lines.push(`${angle.toFixed(3)}°, ${distance.toFixed(4)} off, ${found.doubt ?? "trusted"}: ${samples[0].image} on ${session.executor()}, ${seconds} s`);
  }
  return lines.join("\n");
}

const started = main();
if (location.search === "?check") {
  const report = started.then(check).catch((error) => `error ${error.message ?? error}`);
  report.then((body) => fetch("report", { method: "POST", body }));
} else {
  started.catch((error) => say(String(error.message ?? error), "error"));
}
