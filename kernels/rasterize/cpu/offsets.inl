// Running sums: the lists of all views lie one after the other, a list has its parts in turn, and
// what the parts counted becomes where they begin. Too many intersections overflow here, and are
// refused by their sum, which has 64 bits.
long long intersections = 0, in_boxes = 0;
for (int task = 0; task < work.totals.shape[0]; ++task) {
    work.numbers.data[task] = (int)intersections;
    intersections += work.totals.data[task];
    in_boxes += work.boxes.data[task];
}
lists.count.data[0] = intersections;
lists.box_pairs.data[0] = in_boxes;
lists.offsets.data[lists.offsets.shape[0] - 1] = (int)intersections;
const int tiles = work.counts.shape[1], views = work.counts.shape[0] / parts;
unsigned place = 0;
int* start = lists.starts.data;
for (int view = 0; view < views; ++view)
    for (int tile = 0; tile < tiles; ++tile) {
        *start++ = (int)place;
        for (int part = 0; part < parts; ++part) {
            const int row = view * parts + part;
            int& count = work.counts.data[(size_t)row * tiles + tile];
            const int size = count;
            count = (int)place;
            place += size;
        }
    }
*start = (int)place;
