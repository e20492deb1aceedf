// A camera that a person moves: poses T_world_cam as 16 numbers by rows, OpenCV axes (x right, y down, z forward).
"use strict";

const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add3 = (a, b, share = 1) => [a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]];
const axisOf = (T, column) => [T[column], T[4 + column], T[8 + column]];
const centerOf = T => axisOf(T, 3);

// Vector turned about a unit axis by an angle (Rodrigues).
function turn3(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot3(v, axis) * (1 - c);
  const cross = [axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2], axis[0] * v[1] - axis[1] * v[0]];
  return [0, 1, 2].map(i => v[i] * c + cross[i] * s + axis[i] * along);
}

function poseOf(axes, center) {
  return [0, 1, 2].flatMap(row => [axes[0][row], axes[1][row], axes[2][row], center[row]]).concat([0, 0, 0, 1]);
}

// The camera turned about a pivot by an angle about an axis.
function turnAbout(T, pivot, axis, angle) {
  const arm = turn3(add3(centerOf(T), pivot, -1), axis, angle);
  return poseOf([0, 1, 2].map(column => turn3(axisOf(T, column), axis, angle)), add3(pivot, arm));
}

// Orbit by angles [rad]; the camera does not pass over the pole, where up and forward would coincide.
function orbit(T, pivot, up, yaw, pitch) {
  const turned = turnAbout(T, pivot, up, yaw);
  const tilted = turnAbout(turned, pivot, axisOf(turned, 0), pitch);
  return Math.abs(dot3(axisOf(tilted, 2), up)) < 0.995 ? tilted : turned;
}

// Camera and pivot moved along the camera's axes, [m].
function shift(T, pivot, x, y, z) {
  const step = [x, y, z].reduce((sum, length, column) => add3(sum, axisOf(T, column), length), [0, 0, 0]);
  const center = add3(centerOf(T), step);
  return [poseOf([0, 1, 2].map(column => axisOf(T, column)), center), add3(pivot, step)];
}

// The camera nearer to the pivot, or farther from it, by a factor.
function zoom(T, pivot, factor) {
  const arm = add3(centerOf(T), pivot, -1);
  return poseOf([0, 1, 2].map(column => axisOf(T, column)), add3(pivot, arm, factor));
}

const distanceTo = (T, pivot) => Math.hypot(...add3(centerOf(T), pivot, -1));
