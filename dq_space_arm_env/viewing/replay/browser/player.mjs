// The clock of the replay: simulated time follows real time, whatever the number of pictures per second.

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const LONGEST_GAP = 0.25; // s of real time between pictures; what is longer is a page that was not shown

export class Player {
  constructor(duration, dt) {
    this.duration = duration;
    this.dt = dt;
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.loop = false;
    this.changed = () => {};
    this.last = null;
  }

  play() {
    if (this.time >= this.duration) this.time = 0;
    this.playing = true;
    this.last = null;
    this.changed();
  }

  pause() {
    this.playing = false;
    this.changed();
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.changed();
  }

  /** Go on by whole time steps, from the nearest one. */
  step(count) {
    this.playing = false;
    this.seek((Math.round(this.time / this.dt) + count) * this.dt);
  }

  /** Go to the speed next to this one. */
  shift(places) {
    const place = SPEEDS.indexOf(this.speed) + places;
    this.speed = SPEEDS[Math.min(Math.max(place, 0), SPEEDS.length - 1)];
    this.changed();
  }

  /** Advance to a moment of real time, in ms. */
  tick(now) {
    if (!this.playing) return;
    const elapsed = this.last === null ? 0 : Math.min((now - this.last) / 1000, LONGEST_GAP);
    this.last = now;
    this.time += elapsed * this.speed;
    if (this.time < this.duration) return;
    if (this.loop) {
      this.time %= this.duration;
    } else {
      this.time = this.duration;
      this.pause();
    }
  }
}
