// Flat pictures: depth rendered at a pose, images in colours, curves over time.

const TYPES = { f4: Float32Array, f8: Float64Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i2: Int16Array };

// The data with every array that is kept as bytes as a typed array, its shape beside it.
function unpacked(value) {
  if (Array.isArray(value)) return value.map(unpacked);
  if (value === null || typeof value !== "object") return value;
  if (typeof value.base64 === "string") {
    const bytes = Uint8Array.from(atob(value.base64), (letter) => letter.charCodeAt(0));
    const array = new TYPES[value.type](bytes.buffer);
    array.shape = value.shape;
    return array;
  }
  return Object.fromEntries(Object.entries(value).map(([name, each]) => [name, unpacked(each)]));
}

function row(array, k) {
  const size = array.length / array.shape[0];
  return array.subarray(k * size, (k + 1) * size);
}

function listed(array) {
  return Array.from({ length: array.shape[0] }, (_, k) => Array.from(row(array, k)));
}

// Depth (H W) in metres of a body at a pose, NaN where a pixel does not see it: triangles into a depth buffer.
function rendered(body, camera, pose) {
  const { width, height, fx, fy, cx, cy } = camera, inverse = new Float64Array(width * height);
  const count = body.vertices.length / 3, at = new Float64Array(3 * count);
  for (let k = 0; k < count; k++) {
    const v = seenFrom(camera.pose, placed(pose, row(body.vertices, k)));
    at.set([cx + (fx * v[0]) / v[2], cy + (fy * v[1]) / v[2], v[2] > 1e-4 ? 1 / v[2] : NaN], 3 * k);
  }
  for (let f = 0; f < body.faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((n) => at.subarray(3 * body.faces[f + n], 3 * body.faces[f + n] + 3));
    const area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if (!area || Number.isNaN(a[2] + b[2] + c[2])) continue;
    const from = (n) => Math.max(0, Math.ceil(Math.min(a[n], b[n], c[n])));
    const to = (n, limit) => Math.min(limit - 1, Math.floor(Math.max(a[n], b[n], c[n])));
    for (let y = from(1); y <= to(1, height); y++) {
      for (let x = from(0); x <= to(0, width); x++) {
        const toB = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area;
        const toC = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area;
        if (toB < 0 || toC < 0 || toB + toC > 1) continue;
        // 1 / depth is linear in the image.
        const near = a[2] + toB * (b[2] - a[2]) + toC * (c[2] - a[2]);
        if (near > inverse[y * width + x]) inverse[y * width + x] = near;
      }
    }
  }
  return inverse.map((each) => (each ? 1 / each : NaN));
}

function measuredDepth(image) {
  const scale = (image.high - image.low) / 65534;
  return Float64Array.from(image.depth, (level) => (level ? image.low + (level - 1) * scale : NaN));
}

// The least and the largest; `Math.min(...values)` takes no more values than a call has room for.
function bounds(values) {
  return Array.from(values).reduce(([low, high], each) => [Math.min(low, each), Math.max(high, each)], [Infinity, -Infinity]);
}

function median(values) {
  const sorted = values.filter((each) => !Number.isNaN(each)).sort();
  return sorted.length ? sorted[sorted.length >> 1] : NaN;
}

const GREYS = [[250, 250, 250], [10, 10, 10]];
const BLUE_TO_RED = [[5, 48, 97], [67, 147, 195], [247, 247, 247], [214, 96, 77], [103, 0, 31]];

function shade(colours, share) {
  const at = Math.max(0, Math.min(1, share)) * (colours.length - 1), k = Math.min(colours.length - 2, Math.floor(at));
  return colours[k].map((each, n) => each + (at - k) * (colours[k + 1][n] - each));
}

// Columns and rows [left, top, width, height] about the pixels that see the part, as an image of the same shape.
function surrounding(depth, camera) {
  let [left, top, right, low] = [Infinity, Infinity, -1, -1];
  depth.forEach((each, k) => {
    if (Number.isNaN(each)) return;
    const x = k % camera.width, y = Math.floor(k / camera.width);
    [left, top, right, low] = [Math.min(left, x), Math.min(top, y), Math.max(right, x), Math.max(low, y)];
  });
  if (right < 0) return null;
  const share = Math.min(1, 1.6 * Math.max((right - left + 5) / camera.width, (low - top + 5) / camera.height));
  const width = Math.round(share * camera.width), height = Math.round(share * camera.height);
  const from = (first, last, size, limit) => Math.max(0, Math.min(limit - size, Math.round((first + last - size) / 2)));
  return [from(left, right, width, camera.width), from(top, low, height, camera.height), width, height];
}

// Values (H W), of which a frame is shown, in colours from low to high; NaN in the colour of what is missing.
function paint(canvas, camera, frame, values, colours, low, high, missing) {
  const [left, top, width, height] = frame || [0, 0, camera.width, camera.height];
  [canvas.width, canvas.height] = [width, height];
  canvas.style.aspectRatio = `${width} / ${height}`;
  const context = canvas.getContext("2d"), image = context.createImageData(width, height);
  for (let k = 0; k < width * height; k++) {
    const value = values[(top + Math.floor(k / width)) * camera.width + left + (k % width)];
    const colour = Number.isNaN(value) ? missing : shade(colours, (value - low) / (high - low || 1));
    image.data.set([...colour, 255], 4 * k);
  }
  context.putImageData(image, 0, 0);
}

// A number with as many digits as its size asks for.
function number(value) {
  return Number.isFinite(value) ? String(Number(value.toPrecision(3))).replace("-", "−") : "–";
}

// Steps of 1, 2 or 5 that divide a range into about so many.
function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((each) => each * power >= rough);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(6)));
}

// Curves {x, y, colour, name} over time (s), bands [from, to, colour, opacity], a cursor; null for no data.
function plot(canvas, title, curves, { bands = [], cursor = null } = {}) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  [canvas.width, canvas.height] = [Math.max(1, Math.round(ratio * width)), Math.max(1, Math.round(ratio * height))];
  const flat = canvas.getContext("2d");
  flat.scale(ratio, ratio);
  flat.font = "11px sans-serif";
  const all = curves.flatMap((curve) => Array.from(curve.y)).filter(Number.isFinite);
  const times = curves.flatMap((curve) => [curve.x[0], curve.x[curve.x.length - 1]]).filter(Number.isFinite);
  flat.fillStyle = "#333333";
  flat.fillText(title, 4, 11);
  canvas.dataset.curves = all.length ? curves.length : 0;
  if (!all.length) {
    flat.fillStyle = "#777777";
    flat.fillText("nothing at this step", 44, height / 2);
    return null;
  }
  const [start, end] = bounds(times), [least, most] = bounds(all);
  const room = 0.06 * (most - least) || 1;
  const [low, high] = [least - room, most + room];
  const [left, right, top, bottom] = [44, width - 8, 18, height - 26];
  const x = (value) => left + ((value - start) / (end - start || 1)) * (right - left);
  const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
  for (const [from, to, colour, opacity] of bands) {
    flat.globalAlpha = opacity;
    flat.fillStyle = colour;
    flat.fillRect(x(from), top, Math.max(1, x(to) - x(from)), bottom - top);
  }
  flat.globalAlpha = 1;
  flat.lineWidth = 1;
  flat.textAlign = "right";
  for (const value of ticks(low, high, 5)) {
    flat.strokeStyle = value === 0 ? "#888888" : "#e4e4e4";
    flat.beginPath();
    flat.moveTo(left, y(value));
    flat.lineTo(right, y(value));
    flat.stroke();
    flat.fillStyle = "#333333";
    flat.fillText(String(value), left - 4, y(value) + 4);
  }
  flat.textAlign = "center";
  for (const value of ticks(start, end, 8)) flat.fillText(String(value), x(value), bottom + 12);
  flat.textAlign = "right";
  flat.fillText("time (s)", right, height - 3);
  flat.textAlign = "left";
  flat.save();
  flat.beginPath();
  flat.rect(left, top, right - left, bottom - top);
  flat.clip();
  for (const curve of curves) {
    flat.strokeStyle = curve.colour;
    flat.lineWidth = curve.width || 1.3;
    flat.beginPath();
    curve.x.forEach((time, k) => (Number.isFinite(curve.y[k]) ? flat.lineTo(x(time), y(curve.y[k])) : 0));
    flat.stroke();
  }
  if (cursor !== null) {
    flat.strokeStyle = "#000000";
    flat.lineWidth = 1;
    flat.beginPath();
    flat.moveTo(x(cursor), top);
    flat.lineTo(x(cursor), bottom);
    flat.stroke();
  }
  flat.restore();
  let at = left + 2 + flat.measureText(title).width - 36;
  for (const curve of curves) {
    if (!curve.name) continue;
    flat.fillStyle = curve.colour;
    flat.fillRect(at, 5, 14, 4);
    flat.fillStyle = "#333333";
    flat.fillText(curve.name, at + 18, 11);
    at += 30 + flat.measureText(curve.name).width;
  }
  return (pixel) => start + ((pixel - left) / (right - left)) * (end - start);
}
