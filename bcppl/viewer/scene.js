"use strict";
// Solids and lines, each at any number of poses x y z qw qx qy qz, drawn by one WebGL 2 program; z is up, metres.

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function minus(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

function unit(a) {
  const length = Math.hypot(...a) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
}

function turned(pose, v, back = false) {
  const [w, s] = [pose[3], back ? -1 : 1];
  const axis = [s * pose[4], s * pose[5], s * pose[6]];
  const inner = cross(axis, v).map((each, k) => each + w * v[k]);
  return cross(axis, inner).map((each, k) => v[k] + 2 * each);
}

function placed(pose, v) {
  return turned(pose, v).map((each, k) => each + pose[k]);
}

function seenFrom(pose, v) {
  return turned(pose, minus(v, pose), true);
}

// The pose at a share of the way from one to another that is near.
function between(a, b, share) {
  const side = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
  const mixed = a.map((each, k) => each + share * ((k < 3 ? 1 : side) * b[k] - each));
  const length = Math.hypot(...mixed.slice(3));
  return mixed.map((each, k) => (k < 3 ? each : each / length));
}

// A line through points, in pairs.
function segments(points) {
  return points.slice(1).flatMap((each, k) => [...points[k], ...each]);
}

// Corners of an octahedron of a radius: a point that is seen from all sides.
const DOT = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]].flat();
const DOT_FACES = [0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4, 1, 0, 5, 2, 1, 5, 3, 2, 5, 0, 3, 5];
const scaled = (points, by) => points.map((each) => each * by);

const IDENTITY = [0, 0, 0, 1, 0, 0, 0];

const VERTEX = `#version 300 es
layout(location=0) in vec3 position; layout(location=1) in vec3 normal;
layout(location=2) in vec3 shift; layout(location=3) in vec4 turn; layout(location=4) in vec4 colour;
uniform mat4 clip_from_world;
out vec3 facing; out vec4 tint;
vec3 turned(vec3 v) { return v + 2.0 * cross(turn.yzw, cross(turn.yzw, v) + turn.x * v); }
void main() {
  facing = turned(normal); tint = colour;
  gl_Position = clip_from_world * vec4(turned(position) + shift, 1.0);
}`;

// A line has no normal and no shade.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 facing; in vec4 tint; uniform vec3 light; out vec4 painted;
void main() {
  float lit = length(facing) > 0.1 ? 0.5 + 0.5 * abs(dot(normalize(facing), light)) : 1.0;
  painted = vec4(tint.rgb * lit, tint.a);
}`;

class Scene {
  constructor(canvas, overlay) {
    this.canvas = canvas;
    this.overlay = overlay;
    this.things = [];
    this.labels = [];
    this.target = [0, 0, 0];
    [this.distance, this.azimuth, this.height] = [1, -1.05, 0.5];
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true }));
    if (!gl) return;
    const program = (this.program = gl.createProgram());
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    this.listen();
  }

  // A mesh of vertices (3 V) and faces (3 F), or lines through points (3 P) in pairs where there are no faces.
  geometry(points, faces = null) {
    const gl = this.gl;
    if (!gl) return null;
    const count = faces ? faces.length : points.length / 3;
    const data = new Float32Array(6 * count);
    for (let k = 0; k < count; k++) {
      const from = 3 * (faces ? faces[k] : k);
      data.set([points[from], points[from + 1], points[from + 2]], 6 * k);
    }
    for (let k = 0; faces && k < count; k += 3) {
      const corner = (n) => data.subarray(6 * (k + n), 6 * (k + n) + 3);
      const normal = unit(cross(minus(corner(1), corner(0)), minus(corner(2), corner(0))));
      for (let n = 0; n < 3; n++) data.set(normal, 6 * (k + n) + 3);
    }
    const array = gl.createVertexArray(), instances = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    for (const place of [0, 1]) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 24, 12 * place);
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, instances);
    [[2, 3, 0], [3, 4, 12], [4, 4, 28]].forEach(([place, size, offset]) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 44, offset);
      gl.vertexAttribDivisor(place, 1);
    });
    return { array, instances, count, mode: faces ? gl.TRIANGLES : gl.LINES };
  }

  // Instances [pose, colour "#rrggbb", opacity] of a geometry, drawn after those that were put before.
  put(geometry, instances) {
    const data = new Float32Array(11 * instances.length);
    instances.forEach(([pose, colour, opacity], k) => {
      const tint = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16) / 255);
      data.set([...pose, ...tint, opacity], 11 * k);
    });
    if (geometry) this.things.push({ geometry, data, opaque: instances.every((each) => each[2] === 1) });
  }

  eye() {
    const flat = Math.cos(this.height) * this.distance;
    const away = [flat * Math.cos(this.azimuth), flat * Math.sin(this.azimuth), this.distance * Math.sin(this.height)];
    return this.target.map((each, k) => each + away[k]);
  }

  axes() {
    const back = unit(minus(this.eye(), this.target));
    const right = unit(cross([0, 0, 1], back));
    return [right, cross(back, right), back];
  }

  // Column by column, as WebGL has it.
  matrix() {
    const eye = this.eye(), rows = this.axes(), zoom = 1 / Math.tan(0.35);
    const aspect = this.canvas.width / this.canvas.height;
    const near = 0.02 * this.distance, far = 60 * this.distance;
    const matrix = new Float32Array(16);
    rows.forEach((row, k) => {
      const along = -(row[0] * eye[0] + row[1] * eye[1] + row[2] * eye[2]);
      [...row, along].forEach((value, column) => {
        if (k < 2) matrix[4 * column + k] = value * (k ? zoom : zoom / aspect);
        else {
          matrix[4 * column + 2] = value * ((far + near) / (near - far));
          matrix[4 * column + 3] = -value;
        }
      });
    });
    matrix[14] += (2 * far * near) / (near - far);
    return matrix;
  }

  // Where a point of the world is on the canvas, pixels; null behind the eye.
  project(v, matrix = this.matrix()) {
    const [x, y, , w] = [0, 1, 2, 3].map((k) => matrix[k] * v[0] + matrix[4 + k] * v[1] + matrix[8 + k] * v[2] + matrix[12 + k]);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return w > 0 ? [0.5 * width * (1 + x / w), 0.5 * height * (1 - y / w)] : null;
  }

  draw() {
    const { gl, canvas, overlay } = this, ratio = window.devicePixelRatio || 1;
    for (const each of [canvas, overlay]) {
      each.width = Math.max(1, Math.round(ratio * canvas.clientWidth));
      each.height = Math.max(1, Math.round(ratio * canvas.clientHeight));
    }
    const matrix = this.matrix(), flat = overlay.getContext("2d");
    flat.scale(ratio, ratio);
    flat.font = "12px sans-serif";
    for (const { at, text, colour } of this.labels) {
      const place = this.project(at, matrix);
      if (!place) continue;
      flat.lineWidth = 3;
      flat.strokeStyle = "#ffffff";
      flat.strokeText(text, place[0] + 5, place[1] - 4);
      flat.fillStyle = colour;
      flat.fillText(text, place[0] + 5, place[1] - 4);
    }
    if (!gl) return;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(1, 1, 1, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    gl.enable(gl.POLYGON_OFFSET_FILL); // a body's edges lie on its faces
    gl.polygonOffset(1, 1);
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.program, "clip_from_world"), false, matrix);
    const [right, up, back] = this.axes();
    gl.uniform3fv(gl.getUniformLocation(this.program, "light"), unit(back.map((each, k) => each + 0.4 * up[k] + 0.3 * right[k])));
    for (const { geometry, data, opaque } of this.things) {
      gl.depthMask(opaque);
      gl.bindVertexArray(geometry.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, geometry.instances);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.drawArraysInstanced(geometry.mode, 0, geometry.count, data.length / 11);
    }
  }

  // Drag turns, with shift or another button moves, the wheel comes nearer; a click is given to `picked`.
  listen() {
    const canvas = this.canvas;
    let last = null, moved = 0;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      [last, moved] = [[event.clientX, event.clientY], 0];
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
      [last, moved] = [[event.clientX, event.clientY], moved + Math.abs(dx) + Math.abs(dy)];
      if (event.shiftKey || event.buttons > 1) {
        const [right, up] = this.axes(), scale = (0.73 * this.distance) / canvas.clientHeight;
        this.target = this.target.map((each, k) => each + scale * (dy * up[k] - dx * right[k]));
      } else {
        this.azimuth -= 0.008 * dx;
        this.height = Math.max(-1.55, Math.min(1.55, this.height + 0.008 * dy));
      }
      this.draw();
    });
    canvas.addEventListener("pointerup", (event) => {
      last = null;
      const box = canvas.getBoundingClientRect();
      if (moved < 4 && this.picked) this.picked([event.clientX - box.left, event.clientY - box.top]);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.distance *= Math.exp(0.0012 * event.deltaY);
      this.draw();
    }, { passive: false });
  }
}
