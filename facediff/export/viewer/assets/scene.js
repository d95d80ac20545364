// Drawing in WebGL 2: one canvas, one panel for each animation. Lights are far away and fixed to the camera.

const VERTEX_SHADER = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 colour;
layout(location = 3) in float distance;
layout(location = 4) in float sky;
uniform mat4 view, project;
uniform float highest; // of the heat map in mm; 0 for none
centroid out vec3 facing, albedo; // at the edge of a triangle, values beyond it would show
centroid out float heat, open;
void main() {
  facing = mat3(view) * normal;
  albedo = colour * colour;
  open = sky;
  heat = clamp(distance / max(highest, 1e-6), 0.0, 1.0) * (255.0 / 256.0) + 0.5 / 256.0;
  gl_Position = project * (view * vec4(position, 1.0));
}`;

// Browsers without a graphics card run this on the processor, so powers are products here and a gamma of 2 serves.
const FRAGMENT_SHADER = `#version 300 es
precision highp float;
centroid in vec3 facing, albedo;
centroid in float heat, open;
uniform float highest;
uniform vec4 ink; // of edges, already multiplied by its opacity; clear for a surface
uniform sampler2D ramp;
out vec4 colour;

// A lamp that reaches a little round the edge of the shadow, red light furthest, as it does under skin.
vec3 lamp(float cosine, vec3 strength, vec3 wrap) {
  vec3 lit = max((cosine + wrap) / (1.0 + wrap), 0.0);
  return strength * lit * (1.0 - wrap + wrap * lit); // nearly lit to the power of 1 + wrap
}

void main() {
  if (ink.a > 0.0) {
    colour = ink;
    return;
  }
  vec3 normal = normalize(gl_FrontFacing ? facing : -facing);
  if (highest > 0.0) {
    float shade = 0.6 + 0.4 * max(dot(normal, vec3(-0.199, 0.448, 0.871)), 0.0);
    vec3 scale = texture(ramp, vec2(heat, 0.5)).rgb;
    colour = vec4(scale * sqrt(shade * (gl_FrontFacing ? 1.0 : 0.4)), 1.0);
    return;
  }
  vec3 light = mix(vec3(0.12, 0.09, 0.08), vec3(0.24, 0.26, 0.30), normal.y * 0.5 + 0.5);
  light += lamp(dot(normal, vec3(-0.482, 0.525, 0.701)), vec3(0.80, 0.76, 0.70), vec3(0.37, 0.27, 0.25));
  light += lamp(dot(normal, vec3(0.816, 0.048, 0.576)), vec3(0.14, 0.17, 0.22), vec3(0.62, 0.52, 0.5));
  light += max(dot(normal, vec3(0.724, 0.434, -0.531)), 0.0) * vec3(0.22, 0.23, 0.26);
  // Half way between key light and viewer.
  float shine = max(dot(normal, vec3(-0.261, 0.285, 0.922)), 0.0);
  shine *= shine; // 2
  float wide = shine * shine; // 4
  wide *= wide; // 8
  wide *= wide; // 16
  float narrow = wide * wide; // 32
  vec3 lit = open * (albedo * light + 0.096 * wide * shine + 0.064 * narrow * narrow);
  // Backs are dark: warm behind skin, as the hollow of a mouth, and hardly tinted behind hair of any colour.
  if (!gl_FrontFacing) lit = mix(albedo.b * (albedo.r - albedo.b) * vec3(0.6, 0.13, 0.09), lit, 0.18);
  colour = vec4(sqrt(lit), 1.0);
}`;

const SKIN = [0.9, 0.745, 0.66];
/** Edges over their own surface: red, green, blue and opacity. */
const EDGE = [0.05, 0.06, 0.1, 0.55];
/** Pixels of the screen for one of the page, at most: more are not visible in motion, and slow a laptop down. */
const SHARPEST = 2;
const COARSEST = 0.4;
/** A picture is still when neither the camera nor what it shows was changed by hand for this long. */
const STILL_MS = 200;

/** Whether there is WebGL 2, and whether the processor does its work. */
function graphics() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return { available: false, software: false };
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return { available: true, software: /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name) };
}

class Scene {
  constructor(canvas, faces, ramp) {
    this.canvas = canvas;
    const { available, software } = graphics();
    if (!available) {
      throw new Error("this browser has no WebGL 2, or it is switched off: the faces cannot be drawn");
    }
    // Without a graphics card soft edges cost as much as all the rest: they are drawn only while the picture is still.
    this.finest = software ? 2 : 1;
    this.gl = canvas.getContext("webgl2", { antialias: !software, powerPreference: "high-performance" });
    this.faces = faces;
    this.ramp = ramp;
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.build());
    this.build();
  }

  /** Everything on the graphics card. */
  build() {
    const gl = this.gl;
    this.program = link(gl);
    this.places = {};
    for (const name of ["view", "project", "ramp", "highest", "ink"]) {
      this.places[name] = gl.getUniformLocation(this.program, name);
    }
    this.meshes = this.faces.map((face) => buildMesh(gl, face));
    if (this.ramp) {
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, this.ramp.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, this.ramp);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
      for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
        gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
      }
    }
    this.fresh = true; // buffers are empty: upload before drawing
  }

  upload(number) {
    const gl = this.gl;
    const face = this.faces[number], mesh = this.meshes[number];
    for (const name of ["positions", "normals", "distances"]) {
      if (!face[name]) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh[name]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, face[name]);
    }
  }

  /** Take up an animation's other face at rest, and its colours if it has some. */
  wear(number) {
    const { gl } = this, face = this.faces[number];
    face.sky = skyLight(face.template, face.faces);
    for (const name of ["sky", "colours"]) {
      if (!face[name]) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.meshes[number][name]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, face[name]);
    }
  }

  /** Fit the canvas to its place on the page, with so many times the pixels of the screen on each axis. */
  resize(sharpness) {
    const scale = Math.min(devicePixelRatio || 1, SHARPEST) * sharpness;
    const width = Math.max(1, Math.round(this.canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * scale));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
  }

  /**
   * Draw animations, each into its place. A view is
   *   number: of the animation;
   *   place: left, top, width, height, in shares of the canvas;
   *   inset: shares of the place's height above and below the face that are kept free for words;
   *   part: the part of the place that is drawn, from and to, in shares of its width; all of it if absent;
   *   ink: to draw only the edges, in this colour (4), over what was drawn there before; the surface if absent.
   *
   * Args: the views in the order of drawing; the camera; the extent that all share, so that they appear at one scale; the
   * heat map's end in mm, or 0 for none; whether surfaces show their edges.
   */
  draw(views, camera, extent, highest, edges = false) {
    const gl = this.gl;
    if (gl.isContextLost()) return;
    gl.useProgram(this.program);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.SCISSOR_TEST);
    gl.polygonOffset(1, 1); // edges lie in front of their own surface
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniform1i(this.places.ramp, 0);
    for (const { number, place, inset = [0, 0], part = [0, 1], ink = null } of views) {
      const face = this.faces[number];
      const [left, top, width, height] = place;
      const x = Math.round(left * this.canvas.width), w = Math.round(width * this.canvas.width);
      const h = Math.round(height * this.canvas.height), y = this.canvas.height - Math.round(top * this.canvas.height) - h;
      if (w < 1 || h < 1) continue;
      const from = Math.round(part[0] * w), to = Math.round(part[1] * w);
      gl.viewport(x, y, w, h);
      gl.scissor(x + from, y, to - from, h);
      const { view, project } = camera.matrices(face.centre, extent, w / h, inset);
      gl.uniformMatrix4fv(this.places.view, false, view);
      gl.uniformMatrix4fv(this.places.project, false, project);
      gl.uniform1f(this.places.highest, face.distances ? highest : 0);
      gl.uniform4f(this.places.ink, 0, 0, 0, 0);
      gl.bindVertexArray(this.meshes[number].array);
      gl.vertexAttrib3f(2, ...SKIN);
      gl.vertexAttrib1f(3, 0);
      gl.vertexAttrib1f(4, 1);
      if (ink) gl.clear(gl.DEPTH_BUFFER_BIT); // of the part alone: what hides these edges is their own surface
      if (ink || edges) gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.colorMask(!ink, !ink, !ink, !ink);
      gl.drawElements(gl.TRIANGLES, face.faces.length, gl.UNSIGNED_INT, 0);
      gl.colorMask(true, true, true, true);
      gl.disable(gl.POLYGON_OFFSET_FILL);
      if (ink || edges) this.drawEdges(number, ink ?? EDGE);
    }
    gl.disable(gl.SCISSOR_TEST);
  }

  /** Send an animation's triangles again, some of which are hidden now or shown again. */
  sendFaces(number) {
    const gl = this.gl;
    const face = this.faces[number], mesh = this.meshes[number];
    gl.bindVertexArray(mesh.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, face.faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    gl.deleteBuffer(mesh.edges ?? null);
    mesh.edges = face.edges = null;
  }

  /** Draw an animation's edges; they are found when they are shown for the first time. */
  drawEdges(number, [red, green, blue, opacity]) {
    const gl = this.gl;
    const face = this.faces[number], mesh = this.meshes[number];
    face.edges ??= edgesOf(face.faces, face.positions.length / 3);
    if (mesh.edges) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.edges);
    } else {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, (mesh.edges = gl.createBuffer()));
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, face.edges, gl.STATIC_DRAW);
    }
    gl.enable(gl.BLEND);
    gl.uniform4f(this.places.ink, red * opacity, green * opacity, blue * opacity, opacity);
    gl.drawElements(gl.LINES, face.edges.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces); // the vertex array remembers it
  }
}

/** Fewer pixels while a machine cannot keep up with the motion; a still picture is always sharp. */
class Pace {
  constructor(rate) {
    this.slow = 1.3 * Math.max(1000 / rate, 1000 / 60);
    this.sharpness = 1;
    this.start();
  }

  /** The next play may be quicker than the last. */
  start() {
    this.sharpness = Math.min(1, this.sharpness / 0.75);
    this.last = this.mean = this.count = 0;
  }

  /** Take note of a moment at which a picture may be drawn. */
  beat(now) {
    if (this.last && now - this.last < 1000) { // longer: the page was hidden
      this.count += 1;
      this.mean += (now - this.last - this.mean) / Math.min(this.count, 10);
    }
    this.last = now;
    if (this.count < 12 || this.mean < this.slow) return;
    this.sharpness = Math.max(COARSEST, this.sharpness * 0.75);
    this.count = this.mean = 0;
  }
}

function link(gl) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`the shaders do not compile: ${logs.join(" ")}${gl.getProgramInfoLog(program)}`);
  }
  return program;
}

function buildMesh(gl, face) {
  const mesh = { array: gl.createVertexArray() };
  gl.bindVertexArray(mesh.array);
  const attribute = (place, size, kind, normalised, data, usage) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, usage);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, kind, normalised, 0, 0);
    return buffer;
  };
  mesh.positions = attribute(0, 3, gl.FLOAT, false, face.positions, gl.DYNAMIC_DRAW);
  mesh.normals = attribute(1, 3, gl.FLOAT, false, face.normals, gl.DYNAMIC_DRAW);
  if (face.colours) mesh.colours = attribute(2, 3, gl.UNSIGNED_BYTE, true, face.colours, gl.STATIC_DRAW);
  if (face.distances) mesh.distances = attribute(3, 1, gl.FLOAT, false, face.distances, gl.DYNAMIC_DRAW);
  face.sky ??= skyLight(face.template ?? face.positions, face.faces);
  mesh.sky = attribute(4, 1, gl.FLOAT, false, face.sky, gl.STATIC_DRAW);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, (mesh.faces = gl.createBuffer()));
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, face.faces, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return mesh;
}
