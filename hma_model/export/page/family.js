// Simulate the laboratory's family of robots as hma_data.lab.family does, so that the page knows the truth.
// Lengths are px of the SIZE x SIZE frame with y downward. A point is [x, y]; a shape is a disc round one
// point, a capsule between two, or a convex polygon of more.

const SIZE = 128, GRIP = 0.6, REACH = 8, FINGER = 3.6, ROUNDS = 3;
const EDGE = 0.7;  // px that OpenCV's smoothed shapes are wider: of 0 to 1.2, the images are most alike with it

const clip = (value, low, high) => Math.min(Math.max(value, low), high);
const direction = (angle) => [Math.cos(angle), Math.sin(angle)];
const plus = ([x, y], [dx, dy], share = 1) => [x + dx * share, y + dy * share];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1];
const norm = ([x, y]) => Math.sqrt(x * x + y * y);
const flipped = ([x, y]) => [y, x];
const shape = (points, radius, color, pushes = false) => ({ points, radius, color, pushes });
const middle = (points) => [0, 1].map((i) => points.reduce((sum, point) => sum + point[i], 0) / points.length);

function wrapped(angle) {
  const turned = (angle + Math.PI) % (2 * Math.PI);
  return (turned < 0 ? turned + 2 * Math.PI : turned) - Math.PI;
}

function box(place, angle, length, width) {  // half the length along the angle, and half the width
  const along = direction(angle), side = [-along[1], along[0]];
  return [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => plus(place, plus(along.map((one) => one * a * length), side, b * width)));
}

// The moving parts of each mechanism at a pose, the lowest first; and the point that pushes or holds, with its direction.
const MECHANISMS = {
  Arm: {
    links({ base, facing, lengths }, pose) {
      const points = [base], angles = [];
      lengths.forEach((length, i) => {
        angles.push((i ? angles[i - 1] : facing) + pose[i]);
        points.push(plus(points[i], direction(angles[i]), length));
      });
      return [points, angles];
    },
    shapes(robot, pose) {
      const { lengths, radii, colors, joint } = robot, [points, angles] = this.links(robot, pose);
      const parts = lengths.map((_, i) => shape([points[i], points[i + 1]], radii[i], colors[i], true));
      parts.push(...lengths.map((_, i) => shape([points[i]], radii[i] * 0.5, joint)));
      if (pose.length === lengths.length) return parts;
      const angle = angles.at(-1), ahead = direction(angle), color = colors[lengths.length], end = points.at(-1);
      const side = [-ahead[1], ahead[0]].map((one) => one * (FINGER + 0.6 + 8 * pose.at(-1)));
      for (const root of [plus(end, side), plus(end, side, -1)]) parts.push(shape([plus(root, ahead, 2), plus(root, ahead, 13)], FINGER, color));
      return [...parts, shape(box(plus(end, ahead), angle, 3.6, 12.5), 3.6, color)];
    },
    tip(robot, pose) {
      const [points, angles] = this.links(robot, pose), angle = angles.at(-1);
      return [plus(points.at(-1), direction(angle), pose.length > robot.lengths.length ? 10 : 0), angle];
    },
  },
  Mover: {
    shapes({ form, radius, colors }, pose) {
      const heading = pose.length > 2 ? pose[2] : -Math.PI / 2, place = pose.slice(0, 2);
      const corners = { square: 4, triangle: 3 }[form], far = radius * (corners === 4 ? 1.2 : 1.35);
      const angle = (i) => heading + 2 * Math.PI * (i + (corners === 4 ? 0.5 : 0)) / corners;
      const outline = corners ? Array.from({ length: corners }, (_, i) => plus(place, direction(angle(i)), far)) : [place];
      if (pose.length < 3) return [shape(outline, radius, colors[0], true), shape([place], radius * 0.4, colors[1])];
      const ahead = direction(heading);
      return [shape(outline, radius, colors[0], true), shape([plus(place, ahead, radius * 0.2), plus(place, ahead, radius * 0.75)], radius * 0.42, colors[1])];
    },
    tip(robot, pose) { return [pose.slice(0, 2), 0]; },
  },
  Gantry: {
    place({ upright }, pose) { return upright ? [pose[0], pose[1]] : [pose[1], pose[0]]; },
    shapes(robot, pose) {
      const { upright, width, trolley, colors } = robot, place = this.place(robot, pose), hoist = pose.length > 2 ? pose[2] : 0;
      const ends = upright ? [[place[0], 0], [place[0], SIZE]] : [[0, place[1]], [SIZE, place[1]]];
      return [
        shape(ends, width, colors[0]),
        shape(box(place, 0, trolley, trolley), trolley, colors[1], hoist < 0.5),
        shape([place], 3.6 + (trolley - 3) * hoist, colors[2]),
      ];
    },
    tip(robot, pose) { return [this.place(robot, pose), 0]; },
  },
  Rails: {
    shapes({ upright, places, size, colors }, pose) {
      return places.map((place, i) => {
        const center = upright ? [place, pose[i]] : [pose[i], place];
        return shape(box(center, upright ? Math.PI / 2 : 0, ...size), Math.min(...size), colors[i], true);
      });
    },
    tip({ upright, places }, pose) { const center = [pose[0], places[0]]; return [upright ? flipped(center) : center, 0]; },
  },
  Crane: {
    shapes({ base, length, width, trolley, colors, joint }, pose) {
      const along = direction(pose[0]), place = plus(base, along, pose[1]), back = plus(base, along, -14), magnet = pose.length > 2;
      const parts = [
        shape([back, plus(base, along, length)], width, colors[0]),
        shape(box(back, pose[0], 5, width * 2), 5, colors[2]),
        shape([base], width * 0.6, joint),
        shape([place], trolley, colors[1], !magnet),
      ];
      if (!magnet) return parts;
      const color = joint.map((off, i) => Math.round(off + (colors[3][i] - off) * pose[2]));
      return [...parts, shape([place], trolley * (0.4 + 0.4 * pose[2]), color)];
    },
    tip({ base }, pose) { return [plus(base, direction(pose[0]), pose[1]), pose[0]]; },
  },
};

export class Table {  // a body at a pose among its blocks
  constructor(body, state) {
    this.body = body;
    this.mechanism = MECHANISMS[body.mechanism];
    Object.assign(this, structuredClone(state));
  }

  parts() { return this.mechanism.shapes(this.body, this.pose); }

  advance(action) {  // one control step
    const before = this.holds();
    this.move(action);
    if (this.body.grip) this.carry(before);
    this.push();
  }

  holds() {
    const { grip } = this.body;
    return Boolean(grip) && (this.pose.at(-1) < GRIP) === (grip === "gripper");
  }

  move(given) {
    const { axes, ranges, hz, car } = this.body, step = 1 / hz;
    const action = ranges.map(([low, high], i) => clip(Math.fround(given[i]), low, high));
    if (car) {
      const heading = this.pose[2] + action[1] * step;
      this.pose = [...plus(this.pose.slice(0, 2), direction(heading).map((one) => one * action[0] * step)), heading];
    } else this.pose = this.pose.map((at, i) => {
      const { target, lag, speed } = axes[i], velocity = target ? (action[i] - at) / (lag || 1) : action[i];
      return at + clip(velocity, -speed, speed) * step;
    });
    this.pose = this.pose.map((at, i) => axes[i].turns ? wrapped(at) : clip(at, axes[i].low, axes[i].high));
  }

  carry(before) {  // grasp, move along or release a block; fingers stop at it
    const [tip, angle] = this.mechanism.tip(this.body, this.pose), gripper = this.body.grip === "gripper";
    const along = direction(angle), side = [-along[1], along[0]];
    if (!this.holds()) { this.held = -1; return; }
    if (this.held < 0 && !(gripper && before)) {
      const gaps = this.blocks.map((block) => plus(block, tip, -1)), far = gaps.map(norm), nearest = far.indexOf(Math.min(...far));
      if (far[nearest] < REACH) {
        this.held = nearest;
        this.grasp = [dot(along, gaps[nearest]), gripper ? 0 : dot(side, gaps[nearest])];
      }
    }
    if (this.held < 0) return;
    this.blocks[this.held] = plus(plus(tip, along, this.grasp[0]), side, this.grasp[1]);
    if (gripper) this.pose[this.pose.length - 1] = Math.max(this.pose.at(-1), Math.min(GRIP - 0.01, (this.body.blocks[this.held].radius - 0.9) / 8));
  }

  push() {  // move the blocks out of the parts, off each other and inside the walls
    const parts = this.parts().filter((part) => part.pushes).map(({ points, radius }) => {
      const ends = points.length === 2 ? points : [middle(points), middle(points)];
      return { start: ends[0], along: plus(ends[1], ends[0], -1), radius };
    });
    for (let round = 0; round < ROUNDS; round++) {
      const deepest = this.blocks.map((block, i) => this.pushed(i, parts));
      const apart = this.separate();
      this.blocks = this.blocks.map((block, i) => block.map((one) => clip(one, this.body.blocks[i].radius, SIZE - this.body.blocks[i].radius)));
      if (Math.max(...deepest) <= 0 && !apart) break;
    }
  }

  pushed(number, parts) {  // move a block out of the part that is deepest in it; return how deep that was
    let worst = parts.length && number !== this.held ? -Infinity : 0, way = [0, 0];
    const block = this.blocks[number];
    if (number !== this.held) for (const { start, along, radius } of parts) {
      const share = clip(dot(plus(block, start, -1), along) / Math.max(dot(along, along), 1e-9), 0, 1);
      const gap = plus(plus(block, start, -1), along, -share), far = norm(gap), depth = radius + this.body.blocks[number].radius - far;
      if (depth > worst) { worst = depth; way = far > 1e-6 ? gap.map((one) => one / far) : [1, 0]; }
    }
    this.blocks[number] = plus(block, way, Math.max(worst, 0));
    return worst;
  }

  separate() {
    let touched = false;
    for (let one = 0; one < this.blocks.length; one++) for (let other = 0; other < one; other++) {
      const gap = plus(this.blocks[one], this.blocks[other], -1), far = Math.hypot(...gap) || 1e-6;
      const depth = this.body.blocks[one].radius + this.body.blocks[other].radius - far;
      if (depth <= 0) continue;
      const way = gap.map((part) => part / far * depth);
      if (one !== this.held) this.blocks[one] = plus(this.blocks[one], way);
      if (other !== this.held) this.blocks[other] = plus(this.blocks[other], way, -1);
      touched = true;
    }
    return touched;
  }

  shapes() {  // all that is drawn on the background, the lowest first
    return [...this.body.blocks.flatMap((block, i) => blockShapes(block, this.blocks[i])), ...this.parts()];
  }
}

function blockShapes({ form, radius, angle, color }, place) {
  if (form === "disc") return [shape([place], radius, color)];
  if (form === "box") return [shape(box(place, angle, radius * 0.9, radius * 0.9), radius, color)];
  const along = direction(angle);
  return [
    shape(box(plus(place, along, -radius * 0.5), angle, radius * 0.45, radius), radius, color),
    shape(box(plus(place, along, radius * 0.3), angle, radius * 0.7, radius * 0.45), radius, color),
  ];
}

export function paint(canvas, background, shapes) {
  const context = canvas.getContext("2d");
  context.save();
  context.scale(canvas.width / SIZE, canvas.height / SIZE);
  context.drawImage(background, 0, 0, SIZE, SIZE);
  for (const { points, radius, color } of shapes) {
    context.fillStyle = context.strokeStyle = `rgb(${color})`;
    context.beginPath();
    if (points.length === 1) context.arc(...points[0], radius, 0, 2 * Math.PI);
    else points.forEach((point, i) => i ? context.lineTo(...point) : context.moveTo(...point));
    context.lineWidth = (points.length === 2 ? 2 * radius : 0) + EDGE;
    context.lineCap = context.lineJoin = "round";
    if (points.length !== 2) context.fill();
    context.stroke();
  }
  context.restore();
}
