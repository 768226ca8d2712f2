// Surfaces drawn by WebGL 2: bones first, then the skin's nearest layer over them.

const VERTEX = `#version 300 es
in vec3 place; in vec3 normal; in float amount; in vec3 paint;
uniform mat4 view; uniform mat4 motion; uniform float scale;
out vec3 facing; out float share; out vec3 painted;
void main() {
  gl_Position = view * motion * vec4(place, 1.0);
  facing = mat3(motion) * normal;
  share = amount * scale;
  painted = paint;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 facing; in float share; in vec3 painted;
uniform vec3 colour; uniform vec3 light; uniform float opacity; uniform bool mapping;
uniform sampler2D map;
out vec4 pixel;
void main() {
  vec3 n = normalize(facing);
  float towards = dot(n, light);
  float shade = 0.28 + 0.72 * abs(towards);
  vec3 base = mapping ? texture(map, vec2(clamp(share, 0.0, 1.0), 0.5)).rgb : colour * painted;
  pixel = vec4(base * shade + 0.10 * pow(abs(towards), 24.0), opacity);
}`;

function compiled(gl, type, source) {
  const shader = gl.createShader(type);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
    throw new Error(`the graphics driver refuses a shader: ${gl.getShaderInfoLog(shader)}`);
  }
  return shader;
}

/** The unit normals of the vertices, weighted by area, written into `out`. */
export function vertexNormals(out, places, triangles) {
  out.fill(0);
  for (let i = 0; i < triangles.length; i += 3) {
    const a = 3 * triangles[i], b = 3 * triangles[i + 1], c = 3 * triangles[i + 2];
    const ux = places[b] - places[a], uy = places[b + 1] - places[a + 1], uz = places[b + 2] - places[a + 2];
    const vx = places[c] - places[a], vy = places[c + 1] - places[a + 1], vz = places[c + 2] - places[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    out[a] += x; out[a + 1] += y; out[a + 2] += z;
    out[b] += x; out[b + 1] += y; out[b + 2] += z;
    out[c] += x; out[c + 1] += y; out[c + 2] += z;
  }
  for (let i = 0; i < out.length; i += 3) {
    const size = Math.sqrt(out[i] * out[i] + out[i + 1] * out[i + 1] + out[i + 2] * out[i + 2]) || 1;
    out[i] /= size; out[i + 1] /= size; out[i + 2] /= size;
  }
}

export class Drawing {
  constructor(canvas, mapColours) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
    if (!gl) {
      throw new Error("this browser does not support WebGL 2: enable hardware graphics, or use another browser");
    }
    this.canvas = canvas;
    this.gl = gl;
    this.program = gl.createProgram();
    gl.attachShader(this.program, compiled(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(this.program, compiled(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    ["place", "normal", "amount", "paint"].forEach((name, i) => gl.bindAttribLocation(this.program, i, name));
    gl.linkProgram(this.program);
    gl.useProgram(this.program);
    this.places = {};
    for (const name of ["view", "motion", "scale", "colour", "light", "opacity", "mapping"]) {
      this.places[name] = gl.getUniformLocation(this.program, name);
    }
    const texels = new Uint8Array(mapColours.flatMap((c) => [...c.map((v) => Math.round(255 * v)), 255]));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, mapColours.length, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, texels);
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, name, value);
    // Of surfaces without colours of their vertices.
    gl.vertexAttrib3f(3, 1, 1, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.width = this.height = 1;
  }

  /** A surface on the graphics card; paint: the colours of its vertices, red in the lowest byte. */
  surface(places, triangles, paint) {
    const { gl } = this;
    const made = { array: gl.createVertexArray(), count: triangles.length, buffers: [] };
    const normals = new Float32Array(places.length);
    vertexNormals(normals, places, triangles);
    gl.bindVertexArray(made.array);
    [[places, 3], [normals, 3], [new Float32Array(places.length / 3), 1]].forEach(([data, size], i) => {
      made.buffers.push(gl.createBuffer());
      gl.bindBuffer(gl.ARRAY_BUFFER, made.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, size, gl.FLOAT, false, 0, 0);
    });
    if (paint) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, paint, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(3);
      gl.vertexAttribPointer(3, 3, gl.UNSIGNED_BYTE, true, 4, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return made;
  }

  /** Other places, normals and amounts for the vertices of a surface. */
  update(surface, ...arrays) {
    const { gl } = this;
    arrays.forEach((data, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, surface.buffers[i]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, data);
    });
  }

  /** Other amounts for the vertices of a surface. */
  recolour(surface, amounts) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, surface.buffers[2]);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, amounts);
  }

  /** Fits the picture to the size of its element, in device pixels. */
  fit() {
    const ratio = Math.min(2, globalThis.devicePixelRatio || 1);
    this.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== this.width || this.canvas.height !== this.height) {
      this.canvas.width = this.width;
      this.canvas.height = this.height;
    }
  }

  clear([r, g, b]) {
    const { gl } = this;
    gl.viewport(0, 0, this.width, this.height);
    gl.clearColor(r, g, b, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** Draws parts into the stretch of the picture from share `left` to share `right`. */
  draw(camera, parts, left = 0, right = 1) {
    const { gl, places } = this;
    const x = Math.round(left * this.width);
    const width = Math.max(1, Math.round(right * this.width) - x);
    gl.viewport(x, 0, width, this.height);
    gl.uniformMatrix4fv(places.view, false, camera.matrix(width / this.height));
    const { towards, up } = camera.axes();
    const light = towards.map((v, i) => v + 0.35 * up[i]);
    gl.uniform3fv(places.light, light.map((v) => v / Math.hypot(...light)));
    for (const part of parts.filter((p) => p.opacity >= 0.995)) this.pass(part);
    for (const part of parts.filter((p) => p.opacity > 0.005 && p.opacity < 0.995)) {
      // Depth first, so that of a surface that is seen through only the nearest layer is seen.
      gl.colorMask(false, false, false, false);
      this.pass(part);
      gl.colorMask(true, true, true, true);
      gl.enable(gl.BLEND);
      gl.depthFunc(gl.LEQUAL);
      this.pass(part);
      gl.depthFunc(gl.LESS);
      gl.disable(gl.BLEND);
    }
  }

  pass({ surface, motion, colour, opacity, scale }) {
    const { gl, places } = this;
    gl.uniformMatrix4fv(places.motion, true, motion);
    gl.uniform3fv(places.colour, colour);
    gl.uniform1f(places.opacity, opacity);
    gl.uniform1i(places.mapping, scale ? 1 : 0);
    gl.uniform1f(places.scale, scale || 0);
    gl.bindVertexArray(surface.array);
    gl.drawElements(gl.TRIANGLES, surface.count, gl.UNSIGNED_INT, 0);
  }
}
