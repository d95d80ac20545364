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
