// Undo and redo of states: each is whole, none is changed in place.

const MOST_STEPS = 200;

export class History {
  constructor(first) {
    this.past = [];
    this.future = [];
    this.now = first;
  }

  /** Takes a new state; the one before can be had back by undo. */
  take(state) {
    this.past.push(this.now);
    if (this.past.length > MOST_STEPS) this.past.shift();
    this.future = [];
    this.now = state;
  }

  undo() {
    if (!this.past.length) return false;
    this.future.push(this.now);
    this.now = this.past.pop();
    return true;
  }

  redo() {
    if (!this.future.length) return false;
    this.past.push(this.now);
    this.now = this.future.pop();
    return true;
  }
}
