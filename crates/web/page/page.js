// The page: chooses pictures and cameras, and draws what the library computes.
import init, { Session } from "./sigma_web.js";

/// Most pixels of a photograph to a side.
const LARGEST = 1024;
const at = (id) => document.getElementById(id);

let session;
/// Pixels to a side of what is compared.
let side = 64;
let samples = [];
/// The sample shown, if it is one; its pose is known.
let sample;
/// The photograph: a canvas, transparent where it was.
let photo;
/// A box around the object in it, if one is drawn: left edge, top edge, width, height.
let box;
/// RGBA of the square of it that is compared.
let picture;
/// The camera of the view: 4 × 4, row by row, world_from_camera; and its fx, fy, cx, cy, if they are not those of the field of view.
let camera;
let lens;
/// The library does one thing at a time.
let busy = false;
/// A view is wanted as soon as it can be had.
let stale = false;

/// Of a picture with so many pixels to a row.
const focal = (width) => width / 2 / Math.tan((Number(at("fov").value) * Math.PI) / 360);
/// fx, fy, cx, cy of the photograph's middle square.
const plain = () => {
  const pixels = photo ? (focal(photo.width) * side) / Math.min(photo.width, photo.height) : focal(side);
  return [pixels, pixels, side / 2, side / 2];
};
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
    at("search").disabled = !photo;
  }
  if (stale) look();
}

function draw(id, rgba) {
  at(id).getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(rgba), side, side), 0, 0);
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
    show(await session.render(instance(), camera, new Float64Array(lens ?? plain())));
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

/// Takes an image for the photograph.
async function choose(source, known) {
  const image = await createImageBitmap(source);
  const scale = Math.min(1, LARGEST / Math.max(image.width, image.height));
  photo = new OffscreenCanvas(Math.round(scale * image.width), Math.round(scale * image.height));
  const context = photo.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(image, 0, 0, photo.width, photo.height);
  sample = known;
  box = known?.box;
  if (known) {
    at("object").value = known.object;
    at("fov").value = known.fov.toFixed(2);
  }
  for (const thumbnail of at("samples").children) thumbnail.classList.toggle("chosen", thumbnail.dataset.image === known?.image);
  at("found").textContent = at("pose").textContent = "";
  at("progress").value = 0;
  say(known?.image ?? source.name);
  at("search").disabled = busy || !session;
  compare();
  await look();
}

/// Shows the photograph, and takes its middle square for what is compared, until a search has found a better one.
function compare() {
  lens = undefined;
  const square = Math.min(photo.width, photo.height);
  const canvas = new OffscreenCanvas(side, side);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(photo, (photo.width - square) / 2, (photo.height - square) / 2, square, square, 0, 0, side, side);
  picture = context.getImageData(0, 0, side, side).data;
  draw("picture", picture);
  mark();
}

/// Draws the photograph with the box, and with the outline of what was found: `object` has a 1 for each pixel of it.
function mark(object) {
  const canvas = at("photo");
  [canvas.width, canvas.height] = [photo.width, photo.height];
  const context = canvas.getContext("2d");
  context.drawImage(photo, 0, 0);
  const thick = Math.max(1, canvas.width / 160);
  context.fillStyle = context.strokeStyle = "#0c4";
  for (let i = 0; object && i < object.length; i++) {
    const x = i % canvas.width;
    const isEdge = (x > 0 && object[i] !== object[i - 1]) || (i >= canvas.width && object[i] !== object[i - canvas.width]);
    if (isEdge) context.fillRect(x - thick / 2, Math.floor(i / canvas.width) - thick / 2, thick, thick);
  }
  if (!box) return;
  context.strokeStyle = "#fff";
  context.lineWidth = 2 * thick;
  context.strokeRect(...box);
  context.strokeStyle = "#06c";
  context.lineWidth = thick;
  context.strokeRect(...box);
}

async function chooseSample(known) {
  await choose(await (await fetch(known.image)).blob(), known);
}

/// The page is drawn now: the CPU executor leaves no other time for it.
const drawn = () => new Promise((goOn) => setTimeout(goOn));

/// Looks for the pose: around `rough`, or all around.
async function search(rough) {
  let found;
  await alone(async () => {
    const began = performance.now();
    const observe = (step, steps, loss) => {
      Object.assign(at("progress"), { value: step, max: steps });
      say(`step ${step} of ${steps}, loss ${loss.toPrecision(3)}`);
      return drawn();
    };
    const isAnywhere = at("anywhere").checked;
    // Before the first search on a GPU it is compared with the CPU.
    say((isAnywhere ? "looking where it may be" : "measuring kernels") + ", comparing with the CPU");
    await drawn();
    const { width, height } = photo;
    const pixels = photo.getContext("2d").getImageData(0, 0, width, height).data;
    const bounds = isAnywhere ? new Float64Array() : box && new Float64Array(box);
    const rgba = new Uint8Array(pixels.buffer);
    found = await session.estimate(instance(), rgba, width, focal(width), bounds, rough, at("fast").checked, observe);
    [camera, lens, picture] = [found.world_from_camera, found.intrinsics, found.picture];
    draw("picture", picture);
    mark(found.object);
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
  side = session.side();
  for (const id of ["picture", "view", "difference"]) at(id).width = at(id).height = side;
  at("object").replaceChildren(...session.instances().map((name) => new Option(name)));
  if (object) at("object").value = object;
  camera ??= orbit(0.6, 0.5, session.distance());
  at("where").textContent = why;
}

/// Dragging on the photograph draws a box; a click takes it away.
function dragBox() {
  let from;
  const canvas = at("photo");
  const place = (event) => {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const within = (value, most) => Math.min(most, Math.max(0, value));
    const x = within(((event.clientX - left) / width) * canvas.width, canvas.width);
    return [x, within(((event.clientY - top) / height) * canvas.height, canvas.height)];
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (!photo || busy) return;
    from = place(event);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!from) return;
    const to = place(event);
    box = [0, 1].map((k) => Math.min(from[k], to[k])).concat([0, 1].map((k) => Math.abs(to[k] - from[k])));
    mark();
  });
  canvas.addEventListener("pointerup", () => {
    if (!from) return;
    from = undefined;
    if (box && Math.min(box[2], box[3]) < 4) box = undefined;
    compare();
    look();
  });
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
    // Where the object was found in the photograph, it is not looked at in the middle.
    lens = undefined;
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
  at("fov").addEventListener("change", () => ((lens = undefined), look()));
  at("file").addEventListener("change", () => {
    const [file] = at("file").files;
    if (file) choose(file).catch((error) => say(`${file.name}: ${error.message}`, "error"));
  });
  at("executor").addEventListener("change", () => open().then(look));
  at("search").addEventListener("click", () => {
    const around = document.querySelector("input[name=starts]:checked").value === "around";
    search(around ? undefined : camera);
  });
  dragBox();
  drag();
  say("choose a picture");
  await (samples.length ? chooseSample(samples[0]) : look());
}

/// For `cargo xtask web --check`: searches that begin with the side that each of these samples shows, told to whoever serves the page.
async function check() {
  const lines = [];
  at("fast").checked = true;
  for (const executor of ["cpu", "gpu"]) {
    at("executor").value = executor;
    await open();
    const [cut, boxed] = [samples.find((sample) => !sample.box), samples.find((sample) => sample.box)];
    const cases = [[cut, false], [boxed, false]];
    // A GPU in software takes minutes for that.
    if (executor === "cpu") cases.push([boxed, true]);
    for (const [sample, isAnywhere] of cases) {
      await chooseSample(sample);
      at("anywhere").checked = isAnywhere;
      const found = await search(sample.pose);
      const [angle, distance] = apart(found.world_from_camera, sample.pose);
      const seconds = at("status").textContent.split(" s on ")[0];
      lines.push(`${angle.toFixed(3)}°, ${distance.toFixed(4)} off, ${found.doubt ?? "trusted"}: ${sample.image}${isAnywhere ? ", anywhere," : ""} on ${session.executor()}, ${seconds} s`);
    }
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
