// What is computed for every shown frame: positions, normals, and distances from the truth.

/** Positions (3 V, in mm) from the template and a frame's steps. */
function place(positions, template, steps, step) {
  for (let i = 0; i < positions.length; i++) positions[i] = template[i] + step * steps[i];
}

/** Smooth normals (3 V, unit length): of a vertex the sum of its triangles' normals, weighed by their areas. */
function orient(normals, positions, faces) {
  normals.fill(0);
  for (let i = 0; i < faces.length; i += 3) {
    const a = 3 * faces[i], b = 3 * faces[i + 1], c = 3 * faces[i + 2];
    const ax = positions[a], ay = positions[a + 1], az = positions[a + 2];
    const ux = positions[b] - ax, uy = positions[b + 1] - ay, uz = positions[b + 2] - az;
    const vx = positions[c] - ax, vy = positions[c + 1] - ay, vz = positions[c + 2] - az;
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    normals[a] += x; normals[a + 1] += y; normals[a + 2] += z;
    normals[b] += x; normals[b + 1] += y; normals[b + 2] += z;
    normals[c] += x; normals[c + 1] += y; normals[c + 2] += z;
  }
  for (let i = 0; i < normals.length; i += 3) {
    const x = normals[i], y = normals[i + 1], z = normals[i + 2];
    const scale = 1 / (Math.sqrt(x * x + y * y + z * z) || 1);
    normals[i] = x * scale;
    normals[i + 1] = y * scale;
    normals[i + 2] = z * scale;
  }
}

/**
 * Share of its light that each vertex keeps (V) on a mesh at rest: ambient occlusion by depth maps along lines of sight, as
 * facediff.render.occlusion explains and does it.
 */
function skyLight(points, faces) {
  const cells = 96, lines = 24, lift = 0.5, kept = 0.4, width = 2 * cells, count = points.length / 3;
  const low = [Infinity, Infinity, Infinity], high = low.map((value) => -value);
  for (const vertex of faces) {
    for (let axis = 0; axis < 3; axis++) {
      low[axis] = Math.min(low[axis], points[3 * vertex + axis]);
      high[axis] = Math.max(high[axis], points[3 * vertex + axis]);
    }
  }
  const cell = Math.max(...high.map((value, axis) => value - low[axis]), 1e-12) / cells;
  const middle = low.map((value, axis) => (value + high[axis]) / 2);
  const samples = spread(points, faces, cell), normals = new Float32Array(points.length);
  orient(normals, points, faces);
  const nearest = new Float64Array(width * width), furthest = new Float64Array(width * width);
  const seen = new Float64Array(count), sky = new Float64Array(count);
  const clip = (value) => Math.min(Math.max(value, 0), width - 1);
  for (let line = 0; line < lines; line++) {
    const number = (line >> 1) + 0.5, y = (2 * number) / lines, turn = Math.PI * (1 + Math.sqrt(5)) * number;
    const flat = Math.sqrt(1 - y * y), x = (line % 2 ? -1 : 1) * flat * Math.cos(turn), z = flat * Math.sin(turn);
    // Two directions across the line of sight.
    let u = Math.abs(y) < 0.9 ? [-z, 0, x] : [0, z, -y];
    const length = Math.hypot(...u);
    u = u.map((value) => value / length);
    const v = [y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]];
    const at = (values, i) => {
      const a = values[i] - middle[0], b = values[i + 1] - middle[1], c = values[i + 2] - middle[2];
      const column = Math.round((a * u[0] + b * u[1] + c * u[2]) / cell), row = Math.round((a * v[0] + b * v[1] + c * v[2]) / cell);
      depth = a * x + b * y + c * z;
      return clip(row + cells) * width + clip(column + cells);
    };
    let depth = 0;
    nearest.fill(-Infinity);
    furthest.fill(Infinity);
    for (let i = 0; i < samples.length; i += 3) {
      const place = at(samples, i);
      if (depth > nearest[place]) nearest[place] = depth;
      if (depth < furthest[place]) furthest[place] = depth;
    }
    for (let vertex = 0, i = 0; vertex < count; vertex++, i += 3) {
      const cosine = normals[i] * x + normals[i + 1] * y + normals[i + 2] * z, weight = Math.abs(cosine);
      if (weight <= 0.15) continue;
      const place = at(points, i), slack = cell * (lift + (Math.SQRT2 * Math.sqrt(Math.max(1 - weight * weight, 0))) / weight);
      sky[vertex] += weight;
      if (cosine > 0 ? depth + slack >= nearest[place] : depth - slack <= furthest[place]) seen[vertex] += weight;
    }
  }
  const share = seen.map((value, vertex) => (sky[vertex] ? value / sky[vertex] : 1));
  const around = new Float64Array(count), triangles = new Float64Array(count);
  for (let i = 0; i < faces.length; i += 3) {
    const mean = (share[faces[i]] + share[faces[i + 1]] + share[faces[i + 2]]) / 3;
    for (let corner = i; corner < i + 3; corner++) {
      around[faces[corner]] += mean;
      triangles[faces[corner]] += 1;
    }
  }
  const light = around.map((sum, vertex) => (triangles[vertex] ? sum / triangles[vertex] : 1));
  const outside = light.map((value) => value > 0.1);
  for (let grows = true; grows; ) {
    grows = false;
    for (let i = 0; i < faces.length; i += 3) {
      const count = outside[faces[i]] + outside[faces[i + 1]] + outside[faces[i + 2]];
      if (count === 0 || count === 3) continue;
      outside[faces[i]] = outside[faces[i + 1]] = outside[faces[i + 2]] = 1;
      grows = true;
    }
  }
  return Float32Array.from(light, (value, vertex) => kept + (1 - kept) * (outside[vertex] ? value : 0.45));
}

/** Points on the triangles (3 n) that are nowhere further apart than a cell. */
function spread(points, faces, cell) {
  const samples = [];
  for (let i = 0; i < faces.length; i += 3) {
    const [a, b, c] = [faces[i], faces[i + 1], faces[i + 2]].map((vertex) => points.subarray(3 * vertex, 3 * vertex + 3));
    const side = (p, q) => Math.hypot(p[0] - q[0], p[1] - q[1], p[2] - q[2]);
    const parts = Math.min(Math.max(Math.ceil(Math.max(side(a, b), side(b, c), side(c, a)) / cell), 1), 192);
    for (let first = 0; first < parts; first++) {
      for (let second = 0; first + second < parts; second++) {
        const f = (first + 1 / 3) / parts, s = (second + 1 / 3) / parts;
        for (let axis = 0; axis < 3; axis++) samples.push((1 - f - s) * a[axis] + f * b[axis] + s * c[axis]);
      }
    }
  }
  return Float32Array.from(samples);
}

/** Each vertex's distance from the truth in mm (V), and their mean and largest. */
function compare(distances, positions, truth) {
  let sum = 0, largest = 0;
  for (let i = 0, j = 0; i < distances.length; i++, j += 3) {
    const x = positions[j] - truth[j], y = positions[j + 1] - truth[j + 1], z = positions[j + 2] - truth[j + 2];
    const distance = Math.sqrt(x * x + y * y + z * z);
    distances[i] = distance;
    sum += distance;
    if (distance > largest) largest = distance;
  }
  return { mean: sum / distances.length, largest };
}

/** The two ends of every edge (2 E), each edge once. */
function edgesOf(faces, vertices) {
  const seen = new Set(), ends = [];
  for (let i = 0; i < faces.length; i++) {
    const a = faces[i], b = faces[i % 3 === 2 ? i - 2 : i + 1];
    const edge = Math.min(a, b) * vertices + Math.max(a, b);
    if (seen.has(edge)) continue;
    seen.add(edge);
    ends.push(a, b);
  }
  return new Uint32Array(ends);
}
