"""The page template of `world_page`: a WebGL 2 viewer without external scripts."""

TEMPLATE = r"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>@TITLE@</title>
<style>
  html, body { margin: 0; height: 100%; overflow: hidden; font: 14px/1.45 system-ui, sans-serif; color: #1b2430; }
  canvas { position: fixed; inset: 0; width: 100%; height: 100%; display: block; cursor: grab; background: #f4f6f9; }
  section { position: fixed; left: 14px; top: 14px; width: 330px; padding: 12px 16px; border-radius: 8px;
            background: #ffffffe8; box-shadow: 0 1px 8px #0002; }
  h1 { font-size: 16px; margin: 0 0 6px; }
  p { margin: 4px 0; }
  label { display: block; margin-top: 6px; }
  input[type=range] { width: 100%; margin: 2px 0; }
  b.hit { color: #d9480f; }
  small { color: #5b6675; }
</style>
<canvas></canvas>
<section>
  <h1>@TITLE@</h1>
  @FIGURES@
  <div id="controls">
    <label>Time in the step: <span id="clock"></span><input id="time" type="range" min="0" max="1" step="any"></label>
    <button id="play">Play</button> <button id="next">Next collision</button> <button id="home">Whole world</button>
    <label><input id="alone" type="checkbox"> only robots that collide</label>
    <label><input id="on" type="checkbox"> let them go on instead of stopping</label>
  </div>
  <p id="about"></p>
  <p><small>Drag to turn, shift-drag to move, wheel to zoom. <span id="drawn"></span></small></p>
</section>
<script type="application/json" id="data">@DATA@</script>
<script>
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const element = name => document.getElementById(name);
const canvas = document.querySelector("canvas");
const gl = canvas.getContext("webgl2", {antialias: true, preserveDrawingBuffer: true});
if (!gl) element("about").textContent = "This page needs WebGL 2, which this browser does not offer.";
const floats = text => new Float32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
const indices = text => new Uint32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);

function program(vertexSource, fragmentSource) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  return made;
}
const robots = program(`
layout(location=0) in vec3 vertex; layout(location=1) in vec3 position; layout(location=2) in vec4 orientation;
layout(location=3) in vec3 velocity; layout(location=4) in vec3 spin; layout(location=5) in vec2 state;
uniform mat4 view, projection; uniform float time, goOn;
out vec3 seen; flat out vec3 tint;
vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) + q.x * v); }
void main() {
  float t = goOn > 0.5 ? time : min(time, state.x);
  float angle = t * length(spin);
  vec3 axis = angle > 0.0 ? normalize(spin) : vec3(0.0, 0.0, 1.0);
  vec4 turn = vec4(cos(0.5 * angle), sin(0.5 * angle) * axis);
  vec3 world = turned(turn, turned(orientation, vertex)) + position + t * velocity;
  float shade = 0.86 + 0.14 * fract(float(gl_InstanceID) * 0.618034);
  tint = shade * (state.y > 0.5 ? vec3(0.96, 0.40, 0.12) : vec3(0.52, 0.62, 0.74));
  vec4 eye = view * vec4(world, 1.0);
  seen = eye.xyz;
  gl_Position = projection * eye;
}`, `
in vec3 seen; flat in vec3 tint; uniform vec2 haze; out vec4 colour;
void main() {
  vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
  float light = 0.45 + 0.55 * max(0.0, dot(normal, normalize(vec3(0.35, 0.75, 0.6))));
  float veil = 0.7 * smoothstep(haze.x, haze.y, -seen.z) * (tint.x > 0.8 ? 0.5 : 1.0);
  colour = vec4(mix(light * tint, vec3(0.957, 0.965, 0.976), veil), 1.0);
}`);
const lines = program(`
layout(location=0) in vec3 vertex; uniform mat4 view, projection; uniform vec4 place;
void main() { gl_Position = projection * view * vec4(place.xyz + place.w * vertex, 1.0); }`, `
uniform vec4 paint; out vec4 colour; void main() { colour = paint; }`);

function buffer(target, content) {
  const made = gl.createBuffer();
  gl.bindBuffer(target, made);
  gl.bufferData(target, content, gl.STATIC_DRAW);
}
const kinds = data.kinds.map(kind => {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  buffer(gl.ARRAY_BUFFER, floats(kind.vertices));
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  const faces = indices(kind.faces);
  buffer(gl.ELEMENT_ARRAY_BUFFER, faces);
  buffer(gl.ARRAY_BUFFER, floats(kind.bodies));
  let at = 0;
  for (const [location, size] of [[1, 3], [2, 4], [3, 3], [4, 3], [5, 2]]) {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, gl.FLOAT, false, 60, at);
    gl.vertexAttribDivisor(location, 1);
    at += 4 * size;
  }
  return {array, corners: faces.length, count: kind.count, colliding: kind.colliding};
});
function lineArray(points) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  buffer(gl.ARRAY_BUFFER, new Float32Array(points.flat()));
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  return {array, count: points.length};
}
const half = data.half_extent, edges = [];
for (let a = 0; a < 8; ++a) for (const b of [1, 2, 4]) if (!(a & b)) for (const c of [a, a | b])
  edges.push([0, 1, 2].map(k => (c >> k & 1 ? 1 : -1) * half[k]));
const box = lineArray(edges);
const cross = lineArray([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]]);

const size = Math.hypot(...half);
let camera, contact = -1, playing = false, share = 1, slow = 0;
function home() {
  camera = {target: [0, 0, 0], distance: 3.1 * size, azimuth: -1.07, elevation: 0.42};
  contact = -1;
}
home();
function axes() {
  const [ca, sa] = [Math.cos(camera.azimuth), Math.sin(camera.azimuth)];
  const [ce, se] = [Math.cos(camera.elevation), Math.sin(camera.elevation)];
  return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]];
}
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
let wanted = false;
function redraw() { if (!wanted) { wanted = true; requestAnimationFrame(draw); } }
function draw() {
  wanted = false;
  const began = performance.now(), ratio = Math.min(2, devicePixelRatio || 1);
  const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  gl.viewport(0, 0, width, height);
  gl.clearColor(0.957, 0.965, 0.976, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.CULL_FACE);
  const [right, up, back] = axes(), d = camera.distance, near = Math.max(0.02 * d, d - 3 * size), far = d + 3 * size;
  const view = new Float32Array([right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, camera.target), -dot(up, camera.target), -dot(back, camera.target) - d, 1]);
  const f = 2.6, w = f * height / width;
  const projection = new Float32Array([w, 0, 0, 0, 0, f, 0, 0,
    0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
  const time = Number(element("time").value);
  element("clock").textContent = time.toFixed(3);
  const use = (chosen, values) => {
    gl.useProgram(chosen);
    gl.uniformMatrix4fv(gl.getUniformLocation(chosen, "view"), false, view);
    gl.uniformMatrix4fv(gl.getUniformLocation(chosen, "projection"), false, projection);
    for (const [name, value] of Object.entries(values))
      gl["uniform" + value.length + "fv"](gl.getUniformLocation(chosen, name), value);
  };
  const haze = [Math.max(0, d - 1.2 * size), d + 1.2 * size];
  use(robots, {time: [time], goOn: [element("on").checked ? 1 : 0], haze});
  let drawn = 0;
  for (const kind of kinds) {
    const all = Math.max(kind.colliding, Math.ceil(share * kind.count));
    const count = element("alone").checked ? kind.colliding : all;
    gl.bindVertexArray(kind.array);
    gl.drawElementsInstanced(gl.TRIANGLES, kind.corners, gl.UNSIGNED_INT, 0, count);
    drawn += count;
  }
  use(lines, {place: [0, 0, 0, 1], paint: [0.25, 0.28, 0.33, 1]});
  gl.bindVertexArray(box.array);
  gl.drawArrays(gl.LINES, 0, box.count);
  if (contact >= 0) {
    gl.disable(gl.DEPTH_TEST);
    use(lines, {place: [...data.contacts[contact].point, 0.12 * data.radius], paint: [0, 0, 0, 1]});
    gl.bindVertexArray(cross.array);
    gl.drawArrays(gl.LINES, 0, cross.count);
  }
  element("drawn").textContent = `${drawn.toLocaleString()} of ${data.robots.toLocaleString()} robots are drawn.`;
  gl.finish();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  // Machines without a GPU draw fewer of the robots that do not collide.
  slow = performance.now() - began > 250 ? slow + 1 : 0;
  if (slow >= 2 && share > 0.05) { share *= 0.5; slow = 0; redraw(); }
  if (playing) { element("time").value = (time + 0.006) % 1; redraw(); }
}
function showContact(index) {
  contact = index;
  const chosen = data.contacts[index];
  Object.assign(camera, {target: [...chosen.point], distance: 9 * data.radius});
  element("time").value = chosen.toi;
  element("alone").checked = element("on").checked = true;  // a partner may have stopped even earlier
  element("about").innerHTML = `<b class="hit">Robots ${chosen.ids[0]} and ${chosen.ids[1]}</b> touch at
    ${chosen.toi.toFixed(6)} of the step (contact ${index + 1} of ${data.contacts.length}); the cross marks the point.`;
  redraw();
}
if (!data.moving) element("controls").style.display = "none";
if (!data.contacts.length) element("next").disabled = true;
element("time").value = 1;
element("time").oninput = element("alone").onchange = element("on").onchange = redraw;
element("play").onclick = () => {
  playing = !playing;
  element("play").textContent = playing ? "Pause" : "Play";
  redraw();
};
element("next").onclick = () => showContact((contact + 1) % data.contacts.length);
element("home").onclick = () => {
  home();
  element("alone").checked = element("on").checked = false;
  element("about").textContent = "";
  redraw();
};
canvas.onpointerdown = event => canvas.setPointerCapture(event.pointerId);
canvas.onpointermove = event => {
  if (!event.buttons) return;
  if (event.shiftKey || event.buttons !== 1) {
    const [right, up] = axes(), scale = camera.distance / (1.3 * canvas.clientHeight);
    camera.target = camera.target.map((x, k) => x + scale * (up[k] * event.movementY - right[k] * event.movementX));
  } else {
    camera.azimuth -= 0.006 * event.movementX;
    camera.elevation = Math.max(-1.5, Math.min(1.5, camera.elevation + 0.006 * event.movementY));
  }
  redraw();
};
canvas.oncontextmenu = event => event.preventDefault();
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  camera.distance = Math.max(1.5 * data.radius, Math.min(12 * size, camera.distance * Math.exp(0.0012 * event.deltaY)));
  redraw();
}, {passive: false});
addEventListener("resize", redraw);
const asked = /^#contact=(\d+)$/.exec(location.hash);
if (asked && data.contacts[asked[1] - 1]) showContact(asked[1] - 1);
redraw();
</script>
</html>
"""
