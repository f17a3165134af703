// Rows that begin with the mission's time, limited by the rules of the server (history.py): of each two rows in the
// older half the one with the larger value is kept; a row without values is a gap, across which no line is drawn.
const isGap = (row) => row.slice(1).every((value) => value === null);
const size = (row) => row[1] ?? -Infinity;

export class Rows {
  constructor(limit) {
    this.limit = limit;
    this.rows = [];
  }

  receive(news, isAll) {
    if (isAll) this.rows = news;
    else for (const row of news) this.rows.push(row);
    while (this.rows.length > this.limit) this.thin();
  }

  thin() {
    const half = Math.floor(this.rows.length / 2);
    const kept = this.rows.slice(0, 1);
    let isFirst = true;
    for (const row of this.rows.slice(1, half)) {
      if (isGap(row)) {
        isFirst = true;
        if (!isGap(kept.at(-1))) kept.push(row);
      } else if (isFirst) {
        kept.push(row);
        isFirst = false;
      } else {
        if (size(row) > size(kept.at(-1))) kept[kept.length - 1] = row;
        isFirst = true;
      }
    }
    this.rows = [...(kept.length < half ? kept : this.rows.slice(1, half)), ...this.rows.slice(half)];
  }
}
