// Executes a kernel's instructions: block after block, warp by warp, and watches all it does.
//
// A warp is fragments: lanes that share a place in the code. In order, the fragment that is
// furthest behind goes first, so that lanes meet again where they can. With a seed blocks, warps,
// fragments and atomic operations come in an order drawn from it, and fragments are split at
// random.
#include "opcodes.h"

#include <algorithm>
#include <numeric>
#include <random>
#include <set>
#include <unordered_set>
#include <vector>

#define ATOMICS(X)                                                                                 \
    X("atom.add.u32", u32, "WQW", now + given)                                                     \
    X("atom.add.f32", f32, "WQW", now + given)                                                     \
    X("atom.add.u64", u64, "QQQ", now + given)                                                     \
    X("atom.or.b32", u32, "WQW", now | given)                                                      \
    X("atom.min.s32", s32, "WQW", std::min(now, given))                                            \
    X("atom.max.s32", s32, "WQW", std::max(now, given))
#define ATOMIC_OPCODE(name, T, operands, e) {name, "atomic", operands, 1, ATOMIC, nullptr},

// What a warp's lanes compute together: a number from all of them.
template<class F>
inline void in_all(u8* file, const Instruction& I, u32 lanes, u32 all, F join) {
    auto given = (const u32*)(file + I.given[0]);
    EACH(l, lanes) all = join(all, given[l], l);
    EACH(l, lanes)((u32*)(file + I.to[0]))[l] = all;
}
#define TOGETHER(name, start, e)                                                                   \
    {name, "shuffle", "WWW", 1, WARP, [](u8* file, const Instruction& I, u32 lanes) {              \
         in_all(file, I, lanes, start, [](u32 all, u32 given, int l) { return (u32)(e); });        \
     }},

static void same_lanes(u8* file, const Instruction& I, u32 lanes) {
    auto given = (const u32*)(file + I.given[0]);
    EACH(l, lanes) {
        u32 same = 0;
        EACH(k, lanes) same |= (u32)(given[k] == given[l]) << k;
        ((u32*)(file + I.to[0]))[l] = same;
    }
}

// The lane that a lane of a shuffle reads, as the ISA has it: b is a lane or a distance, c the last
// lane of a segment and, from bit 8, the bits of a lane that name its segment.
static int source_of(char mode, int lane, u32 b, u32 c, bool& inside) {
    int segment = c >> 8 & 31, last = (lane & segment) | (c & 31 & ~segment), by = b & 31;
    int from = mode == 'u' ? lane - by
        : mode == 'd'      ? lane + by
        : mode == 'b'      ? lane ^ by
                           : (lane & segment) | (by & ~segment);
    inside = mode == 'u' ? from >= last : from <= last;
    return inside ? from : lane;
}

static void halves(u8* file, const Instruction& I, u32 lanes) {
    EACH(l, lanes) {
        u32 both = ((u32*)(file + I.given[0]))[l];
        ((u32*)(file + I.to[0]))[l] = both & 0xFFFF, ((u32*)(file + I.to[1]))[l] = both >> 16;
    }
}

static const Opcode OPCODES[] = {
    COMPUTING ATOMICS(ATOMIC_OPCODE)  // what the lanes do alone
    {"ld", "load", "", 0, LOAD, nullptr},
    {"st", "store", "", 0, STORE, nullptr},
    {"bra", "jump", "", 0, BRANCH, nullptr},
    {"ret", "jump", "", 0, EXIT, nullptr},
    {"exit", "jump", "", 0, EXIT, nullptr},
    {"mov.b32 to 2", "move", "WWW", 2, PLAIN, halves},
    {"bar.sync", "barrier", "", 0, BLOCK, nullptr},
    {"bar.red.popc.u32", "barrier", "WW", 1, BLOCK, nullptr},
    {"bar.warp.sync", "barrier", "W", 0, WARP, nullptr},
    TOGETHER("vote.sync.ballot.b32", 0, all | (u32)(given != 0) << l) TOGETHER("redux.sync.or.b32",
        0, all | given) TOGETHER("redux.sync.max.s32", 1u << 31, std::max((s32)all, (s32)given)){
        "match.any.sync.b32", "shuffle", "WWW", 1, WARP, same_lanes},
    {"shfl.sync.up.b32", "shuffle", "WWWWWW", 2, SHUFFLE, nullptr},
    {"shfl.sync.down.b32", "shuffle", "WWWWWW", 2, SHUFFLE, nullptr},
    {"shfl.sync.bfly.b32", "shuffle", "WWWWWW", 2, SHUFFLE, nullptr},
    {"shfl.sync.idx.b32", "shuffle", "WWWWWW", 2, SHUFFLE, nullptr},
};
const int COUNT = sizeof OPCODES / sizeof *OPCODES;

enum Space { GENERIC, IN_GLOBAL, IN_SHARED, IN_LOCAL, IN_PARAM };  // and all below as launch.py
typedef s32 Fault;
const Fault OUT_OF_BOUNDS = 0, MISALIGNED = 1, UNWRITTEN = 2, SHARED_RACE = 3, GLOBAL_RACE = 4;
const Fault DIVERGENT = 5, DEADLOCK = 6, MASK = 7, ENDLESS = 8;

struct Finding {
    s32 fault, at, block, thread;
    u64 address;
    s64 times;
};

struct Constant {
    s64 at;
    u64 value;
    s64 wide;
};

struct Array {  // memory that a launch may touch, in units of 1 << unit bytes
    u64 base, size;
    s64 unit;
};

// What an instruction asked for: lanes that came to it, and branches that parted them; bytes of
// global memory, sectors of 32 bytes of global or local memory, those of global memory that the
// launch had not touched before; passes of shared memory (32 banks of 4 bytes), those that
// conflicts of banks add to them, and passes if all lanes could be served together.
struct Count {
    s64 lanes, splits, bytes, sectors, first, passes, conflicts, together;
};

struct Launch {
    const Instruction* code;
    const Constant* constants;
    const u8* params;
    const Array* arrays;
    s64 constant_count, file_size, params_size, array_count, shared_size, shared_unit, local_size;
    s64 threads[3], blocks[3];
    s64 special[14];  // registers of tid, ntid, ctaid, nctaid (x, y, z each), laneid, lanemask_lt;
                      // or -1
    u64 seed, approximate;
    s64 limit;  // instructions of a warp in a block
    Finding* findings;
    s64 most_findings, found;
    s64* executed;  // by instruction, how many warps' fragments
    Count* counts;  // by instruction, or none
    s64 steps;
};

// Who touched a unit of memory last, after how many barriers of its block and of its warp.
struct Touch {
    u32 who;
    u32 barriers, warp_barriers;
};
const u32 NOBODY = ~0u, THREAD = (1u << 28) - 1;  // a thread is its block * 1024 + its number
const u32 LANES = 1u << 28, WARPS = 1u << 29, BLOCKS = 1u << 30, ATOMICALLY = 1u << 31;  // several

struct Shadow {
    u32 tag;  // of the launch, or for shared memory of the block, of which this tells
    bool known;
    Touch writer, reader;
};

struct Region {
    u64 base, size;
    s64 unit;
    u8* memory;
    Shadow* shadows;
    Fault race;
};

enum State { READY, AT_WARP, AT_BLOCK };
struct Fragment {
    u32 at, lanes;
    State state;
};

struct Warp {
    int index;
    u8* file;
    u32* known;  // of each register, the lanes in which it holds what was written
    u32 live, barriers;
    s64 steps;
    std::vector<Fragment> fragments;

    template<class T>
    T& slot(s32 r, int lane) const {
        return ((T*)(file + r))[lane];
    }
    u32& lanes_known(s32 r) const { return known[r / 128]; }
};

enum Use { READ, WRITE, UPDATE };
static u32 tags = 0;
static std::vector<Shadow> kept;  // the shadows of all arrays, from launch to launch

struct Machine {
    Launch& L;
    std::mt19937_64 draw;
    const bool drawn;
    std::vector<Warp> warps;
    std::vector<u8> files, shared, local, local_known;
    std::vector<u32> knowns;
    std::vector<Shadow> shared_shadows;
    std::vector<Region> arrays;
    std::unordered_set<u64> touched;  // sectors of global memory, where they are counted
    Region shared_region;
    const s64 threads;  // of a block
    const Region* last = nullptr;
    u32 block = 0, barriers = 0, tag = 0, shared_tag = 0;
    bool stop = false;

    explicit Machine(Launch& launch)
        : L(launch), draw(launch.seed), drawn(launch.seed != 0),
          threads(launch.threads[0] * launch.threads[1] * launch.threads[2]) {
        int count = (threads + 31) / 32;
        warps.resize(count);
        files.resize(count * L.file_size + 64);
        knowns.resize(count * L.file_size / 128);
        shared.resize(L.shared_size);
        shared_shadows.resize((L.shared_size >> L.shared_unit) + 1);
        shared_region = {SHARED, (u64)L.shared_size, L.shared_unit, shared.data(),
            shared_shadows.data(), SHARED_RACE};
        local.resize(threads * L.local_size);
        local_known.resize(local.size());
        size_t units = 0;
        for (s64 i = 0; i < L.array_count; i++) units += (L.arrays[i].size >> L.arrays[i].unit) + 1;
        if (kept.size() < units) kept.resize(units);
        units = 0;
        for (s64 i = 0; i < L.array_count; i++) {
            auto& a = L.arrays[i];
            arrays.push_back({a.base, a.size, a.unit, (u8*)a.base, &kept[units], GLOBAL_RACE});
            units += (a.size >> a.unit) + 1;
        }
        tag = ++tags;
        u8* first = (u8*)(((u64)files.data() + 63) & ~63ull);
        for (int w = 0; w < count; w++) {
            warps[w].index = w;
            warps[w].file = first + w * L.file_size;
            warps[w].known = knowns.data() + w * L.file_size / 128;
        }
    }

    void report(Fault fault, u32 at, u32 thread, u64 address = 0) {
        for (s64 i = 0; i < L.found; i++)
            if (L.findings[i].fault == fault && L.findings[i].at == (s32)at) {
                L.findings[i].times++;
                return;
            }
        if (L.found < L.most_findings)
            L.findings[L.found++] = {fault, (s32)at, (s32)block, (s32)thread, address, 1};
    }

    const Region* array_of(u64 address, u64 size) {
        auto holds = [&](const Region& r) {
            return address - r.base < r.size && address - r.base + size <= r.size;
        };
        if (last && holds(*last)) return last;
        auto after = std::upper_bound(arrays.begin(), arrays.end(), address,
            [](u64 x, const Region& r) { return x < r.base; });
        if (after == arrays.begin() || !holds(*(after - 1))) return nullptr;
        return last = &*(after - 1);
    }

    // Whether barriers lie between what was done and what thread `me` of warp `w` does now.
    bool ordered(const Touch& t, const Warp& w, u32 me) const {
        if (t.who == NOBODY || t.who == me) return true;
        if (t.who & (ATOMICALLY | BLOCKS) || (t.who & THREAD) >> 10 != block) return false;
        if (t.barriers != barriers) return true;
        return !(t.who & WARPS) && (t.who >> 5 & 31) == (u32)w.index
            && t.warp_barriers != w.barriers;
    }

    // Adds a reader to those that may read at the same time.
    void join(Touch& t, const Warp& w, u32 me) const {
        if (t.who != NOBODY && (t.who & BLOCKS || (t.who & THREAD) >> 10 != block)) t.who = BLOCKS;
        else if (ordered(t, w, me)) t = {me, barriers, w.barriers};
        else t.who |= (t.who >> 5 & 31) == (u32)w.index ? LANES : WARPS;
    }

    // What an access means for the units of memory it touches.
    void touch(const Region& r, const Warp& w, u32 thread, u32 at, u64 address, u32 size, Use use,
        const u8* given, bool& known) {
        u32 me = block * 1024 + thread, now = r.race == SHARED_RACE ? shared_tag : tag;
        u64 from = address - r.base;
        bool same = use == WRITE && !memcmp(r.memory + from, given, size), race = false;
        for (u64 i = from >> r.unit; i <= (from + size - 1) >> r.unit; i++) {
            Shadow& s = r.shadows[i];
            if (s.tag != now) s = {now, r.race == GLOBAL_RACE, {NOBODY, 0, 0}, {NOBODY, 0, 0}};
            bool after_writer = ordered(s.writer, w, me), after_reader = ordered(s.reader, w, me);
            if (use == READ) {
                race |= !after_writer;
                known &= s.known;
                join(s.reader, w, me);
            } else if (use == UPDATE) {
                race |= !(after_writer || s.writer.who == ATOMICALLY) || !after_reader;
                s.writer = {ATOMICALLY, 0, 0};
            } else {
                // two that write the same, or write what is there, do no harm
                bool alone = after_writer && after_reader;
                race |= !alone && !same;
                if (alone || !same) s.writer = {me, barriers, w.barriers};
                s.known = known || r.race == GLOBAL_RACE;
            }
        }
        if (race) report(r.race, at, thread, address);
    }

    s32 space_of(const Instruction& I, u64 address) const {
        if (I.space != GENERIC) return I.space;
        return address >> 56 == 1 ? IN_SHARED : address >> 56 == 2 ? IN_LOCAL : IN_GLOBAL;
    }

    // The memory of an access, or nullptr. `known` tells or, if it is read, is told whether what is
    // there was written.
    u8* place(Warp& w, int lane, const Instruction& I, u32 at, u64 address, Use use,
        const u8* given, bool& known) {
        u32 thread = w.index * 32 + lane, size = I.size;
        s32 space = space_of(I, address);
        if (space == IN_GLOBAL || space == IN_SHARED) {
            if (space == IN_SHARED) address |= SHARED;
            const Region* r = space == IN_GLOBAL ? array_of(address, size) : &shared_region;
            if (!r || address - r->base + size > r->size) {
                report(OUT_OF_BOUNDS, at, thread, address);
                return nullptr;
            }
            touch(*r, w, thread, at, address, size, use, given, known);
            return r->memory + (address - r->base);
        }
        address &= ~LOCAL;
        if (address + size > (u64)(space == IN_LOCAL ? L.local_size : L.params_size)
            || (space == IN_PARAM && use != READ)) {
            report(OUT_OF_BOUNDS, at, thread, address);
            return nullptr;
        }
        if (space == IN_PARAM) return (u8*)L.params + address;
        u64 i = thread * L.local_size + address;
        for (u32 b = 0; b < size; b++) {
            if (use == READ) known &= local_known[i + b] != 0;
            else local_known[i + b] = known;
        }
        return &local[i];
    }

    u64 address_of(Warp& w, int lane, const Instruction& I) {
        if (I.wide_address) return w.slot<u64>(I.given[0], lane) + I.offset;
        return w.slot<u32>(I.given[0], lane) + (u32)I.offset;
    }

    bool aligned(const Instruction& I, u64 address, u32 thread, u32 at) {
        if (address % (I.size * I.vector) == 0) return true;
        report(MISALIGNED, at, thread, address);
        return false;
    }

    void load(Warp& w, const Instruction& I, u32 lanes, u32 at) {
        for (int k = 0; k < I.vector; k++) w.lanes_known(I.to[k]) &= ~lanes;
        EACH(l, lanes) {
            u64 address = address_of(w, l, I);
            bool fits = aligned(I, address, w.index * 32 + l, at);
            for (int k = 0; k < I.vector; k++) {
                bool known = true;
                const u8* p = nullptr;
                if (fits) p = place(w, l, I, at, address + k * I.size, READ, nullptr, known);
                u64 x = ~0ull;  // NaN, where nothing can be read
                if (p) memcpy(&(x = 0), p, I.size);
                int free = I.is_signed ? 64 - 8 * I.size : 0;
                x = (s64)(x << free) >> free;
                if (I.wide) w.slot<u64>(I.to[k], l) = x;
                else w.slot<u32>(I.to[k], l) = x;
                w.lanes_known(I.to[k]) |= (u32)known << l;
            }
        }
    }

    void store(Warp& w, const Instruction& I, u32 lanes, u32 at) {
        EACH(l, lanes) {
            u64 address = address_of(w, l, I);
            if (!aligned(I, address, w.index * 32 + l, at)) continue;
            for (int k = 0; k < I.vector; k++) {
                s32 r = I.given[1 + k];
                u64 x = I.wide ? w.slot<u64>(r, l) : w.slot<u32>(r, l);
                bool known = w.lanes_known(r) >> l & 1;
                if (I.space == IN_GLOBAL || (I.space == GENERIC && address < SHARED))
                    demand(w, r, 1u << l, at);
                if (u8* p = place(w, l, I, at, address + k * I.size, WRITE, (u8*)&x, known))
                    memcpy(p, &x, I.size);
            }
        }
    }

    // As the CUDA C++ Programming Guide has it: shared memory serves a warp's lanes together, or
    // half of them where each asks for 8 bytes, or a quarter for 16; lanes that ask for the same
    // word share it. Threads' words of local memory lie side by side.
    void count(Warp& w, const Instruction& I, u32 there, u32 lanes, Count& c) {
        Kind kind = OPCODES[I.op].kind;
        c.lanes += __builtin_popcount(there);
        c.splits += kind == BRANCH && lanes && lanes != there;
        if (kind != LOAD && kind != STORE && kind != ATOMIC) return;
        int size = I.size * I.vector, group = size > 8 ? 8 : size > 4 ? 16 : 32;
        std::set<u64> sectors, all;
        int together[32] = {};
        for (int begin = 0; begin < 32; begin += group) {
            std::set<u64> words;
            int banks[32] = {};
            EACH(l, lanes >> begin << begin & ~0u >> (32 - group - begin)) {
                u64 address = address_of(w, l, I);
                s32 space = space_of(I, address);
                c.bytes += space == IN_GLOBAL ? size : 0;
                for (u64 word = address / 4; word <= (address + size - 1) / 4; word++) {
                    if (space == IN_GLOBAL) c.first += touched.insert(word / 8).second;
                    if (space == IN_GLOBAL) sectors.insert(word / 8);
                    else if (space == IN_LOCAL) sectors.insert((word * 32 + l) / 8);
                    if (space != IN_SHARED) continue;
                    banks[word % 32] += words.insert(word).second;
                    together[word % 32] += all.insert(word).second;
                }
            }
            int passes = *std::max_element(banks, banks + 32);
            c.passes += passes;
            c.conflicts += std::max(passes - 1, 0);
        }
        c.sectors += sectors.size();
        c.together += *std::max_element(together, together + 32);
    }

    template<class T, class F>
    void update(Warp& w, const Instruction& I, u32 lanes, u32 at, F f) {
        int order[32], count = 0;
        EACH(l, lanes) order[count++] = l;
        if (drawn) std::shuffle(order, order + count, draw);
        for (int i = 0; i < count; i++) {
            int l = order[i];
            u64 address = address_of(w, l, I);
            bool known = true;
            if (!aligned(I, address, w.index * 32 + l, at)) continue;
            u8* p = place(w, l, I, at, address, UPDATE, nullptr, known);
            if (!p) continue;
            T now, next;
            memcpy(&now, p, sizeof now);
            next = f(now, value<T>(w.slot<Slot<T>>(I.given[1], l)));
            memcpy(p, &next, sizeof next);
            w.slot<Slot<T>>(I.to[0], l) = slot<T>(now);
        }
        w.lanes_known(I.to[0]) |= lanes;
    }

    void atomic(Warp& w, const Instruction& I, u32 lanes, u32 at) {
        const char* name = OPCODES[I.op].name;
#define UPDATES(text, T, operands, e)                                                              \
    if (!strcmp(name, text))                                                                       \
        return update<T>(w, I, lanes, at, [](T now, T given) { return (T)(e); });
        ATOMICS(UPDATES)
    }

    u32 set_lanes(const Warp& w, s32 predicate) {
        u32 lanes = 0;
        for (int l = 0; l < 32; l++) lanes |= (u32)(w.slot<u32>(predicate, l) != 0) << l;
        return lanes;
    }

    // Reports lanes that depend on a register that nobody wrote.
    void demand(Warp& w, s32 r, u32 lanes, u32 at) {
        if (u32 unknown = lanes & ~w.lanes_known(r))
            report(UNWRITTEN, at, w.index * 32 + __builtin_ctz(unknown));
    }

    // The lanes in which a result is known; what is not is reported where it matters, no sooner.
    u32 known_after(Warp& w, const Instruction& I) {
        auto known = [&](int i) { return w.lanes_known(I.given[i]); };
        Kind kind = OPCODES[I.op].kind;
        if (kind == SELECT) {
            u32 first = set_lanes(w, I.given[2]);
            return known(2) & ((first & known(0)) | (~first & known(1)));
        }
        u32 lanes = ~0u;
        for (int i = 0; i < I.reads; i++) lanes &= known(i);
        if (kind != AND && kind != OR) return lanes;
        u32 a = set_lanes(w, I.given[0]), b = set_lanes(w, I.given[1]);
        if (kind == AND) a = ~a, b = ~b;  // one that is false decides alone
        return lanes | (known(0) & a) | (known(1) & b);
    }

    void add(Warp& w, Fragment f) {
        if (!f.lanes) return;
        if (!drawn && f.state == READY)
            for (auto& g : w.fragments)
                if (g.at == f.at && g.state == READY) {
                    g.lanes |= f.lanes;
                    return;
                }
        w.fragments.push_back(f);
    }

    void meet(Warp& w, Fragment& f, State state) {  // takes fragments at the same place into f
        auto there = [&](const Fragment& g) {
            return g.state == state && g.at == f.at
                && (state != AT_WARP || mask_of(w, g) == mask_of(w, f));
        };
        for (auto& g : w.fragments)
            if (there(g)) f.lanes |= g.lanes;
        w.fragments.erase(
            std::remove_if(w.fragments.begin(), w.fragments.end(), there), w.fragments.end());
    }

    u32 mask_of(const Warp& w, const Fragment& f) {
        const Instruction& I = L.code[f.at];
        return w.slot<u32>(I.given[I.reads - 1], __builtin_ctz(f.lanes));
    }

    bool complete(const Warp& w, const Fragment& f) { return !(mask_of(w, f) & w.live & ~f.lanes); }

    // What a lane reads is known if it is in that lane; of lanes outside the mask nothing is.
    void shuffle(Warp& w, const Instruction& I, u32 lanes, u32 at) {
        char mode = OPCODES[I.op].name[strlen("shfl.sync.")];
        u32 found[32], inside[32], there = lanes & w.lanes_known(I.given[0]), known = 0;
        demand(w, I.given[1], lanes, at), demand(w, I.given[2], lanes, at);
        EACH(l, lanes) {
            bool is_inside;
            int from = source_of(
                mode, l, w.slot<u32>(I.given[1], l), w.slot<u32>(I.given[2], l), is_inside);
            found[l] = w.slot<u32>(I.given[0], from), inside[l] = is_inside;
            known |= (there >> from & 1) << l;
        }
        EACH(l, lanes)
        w.slot<u32>(I.to[0], l) = found[l], w.slot<u32>(I.to[1], l) = inside[l];
        w.lanes_known(I.to[0]) = (w.lanes_known(I.to[0]) & ~lanes) | known;
        w.lanes_known(I.to[1]) |= lanes;
    }

    // Executes what all lanes of a mask do together; false: the fragment waits for others.
    bool together(Warp& w, Fragment& f, u32 lanes) {
        const Instruction& I = L.code[f.at];
        u32 mask = mask_of(w, f), others = 0;
        EACH(l, f.lanes) others |= (u32)(w.slot<u32>(I.given[I.reads - 1], l) != mask) << l;
        if (lanes != f.lanes || f.lanes & ~others & ~mask) report(MASK, f.at, w.index * 32, mask);
        if (others) add(w, {f.at, others, READY}), f.lanes &= ~others;
        meet(w, f, AT_WARP);
        if (!complete(w, f)) {
            f.state = AT_WARP;
            return false;
        }
        if (OPCODES[I.op].kind == SHUFFLE) shuffle(w, I, f.lanes, f.at);
        else if (OPCODES[I.op].run) {
            demand(w, I.given[0], f.lanes, f.at);
            OPCODES[I.op].run(w.file, I, f.lanes);
            w.lanes_known(I.to[0]) |= f.lanes;
        } else if (f.lanes == w.live) w.barriers++;
        return true;
    }

    // Executes one instruction of a fragment; false: the fragment is gone, waits or was split.
    bool step(Warp& w, Fragment& f) {
        const Instruction& I = L.code[f.at];
        L.executed[f.at]++;
        if (++w.steps > L.limit) {
            report(ENDLESS, f.at, w.index * 32);
            stop = true;
            return false;
        }
        u32 lanes = f.lanes;
        if (I.guard >= 0) {
            demand(w, I.guard, lanes, f.at);
            u32 set = set_lanes(w, I.guard);
            lanes &= I.inverted ? ~set : set;
        }
        if (L.counts) count(w, I, f.lanes, lanes, L.counts[f.at]);
        switch (OPCODES[I.op].kind) {
        case BRANCH:
            if (lanes && lanes != f.lanes) {
                add(w, {(u32)I.target, lanes, READY});
                f.lanes &= ~lanes;
                f.at++;
                return false;
            }
            f.at = lanes ? I.target : f.at + 1;
            return true;
        case EXIT:
            w.live &= ~lanes;
            f.lanes &= ~lanes;
            f.at++;
            return f.lanes != 0;
        case BLOCK:
            if (lanes != f.lanes) report(DIVERGENT, f.at, w.index * 32);
            f.state = AT_BLOCK;
            return false;
        case WARP:
        case SHUFFLE: {
            u32 before = f.lanes;
            if (!together(w, f, lanes)) return false;
            f.at++;
            return f.lanes == before;  // else those of another mask are behind
        }
        case LOAD:
        case STORE:
        case ATOMIC:
            demand(w, I.given[0], lanes, f.at);
            if (OPCODES[I.op].kind == LOAD) load(w, I, lanes, f.at);
            else if (OPCODES[I.op].kind == STORE) store(w, I, lanes, f.at);
            else demand(w, I.given[1], lanes, f.at), atomic(w, I, lanes, f.at);
            break;
        default: {
            u32 known = known_after(w, I);
            OPCODES[I.op].run(w.file, I, lanes);
            for (int k = 0; k < I.writes; k++) {
                u32& result = w.lanes_known(I.to[k]);
                result = (result & ~lanes) | (known & lanes);
            }
        }
        }
        f.at++;
        return true;
    }

    // Runs a warp until all its fragments wait or are gone, or for some turns of a drawn length.
    void run_warp(Warp& w, s64 turns) {
        for (; !stop && turns; turns--) {
            auto behind = [](const Fragment& a, const Fragment& b) {
                return a.state != b.state ? a.state < b.state : a.at < b.at;
            };
            auto& all = w.fragments;
            std::sort(all.begin(), all.end(), behind);
            size_t ready = 0;
            while (ready < all.size() && all[ready].state == READY) ready++;
            if (!ready) return;
            size_t chosen = drawn ? draw() % ready : 0;
            u32 until = !drawn && ready > 1 ? all[1].at : ~0u;
            Fragment f = all[chosen];
            all.erase(all.begin() + chosen);
            s64 slice = L.limit + 1;
            if (drawn) {
                slice = 1 + draw() % 200;
                if (draw() % 4) meet(w, f, READY);
                u32 part = draw() % 24 || all.size() > 5 ? 0 : f.lanes & (u32)draw();
                if (part != f.lanes) add(w, {f.at, part, READY}), f.lanes &= ~part;
            }
            bool goes_on = true;
            while (goes_on && slice-- && f.at < until) goes_on = step(w, f);
            add(w, f);
            for (auto& g : w.fragments)  // lanes that left may be the last that others waited for
                if (g.state == AT_WARP && complete(w, g)) g.state = READY;
        }
    }

    void begin(Warp& w) {
        u32 first = w.index * 32, count = std::min<s64>(32, threads - first);
        std::fill(w.known, w.known + L.file_size / 128, 0);
        w.live = count == 32 ? ~0u : (1u << count) - 1;
        w.barriers = w.steps = 0;
        w.fragments.assign(1, {0, w.live, READY});
        for (s64 i = 0; i < L.constant_count; i++) {
            auto& c = L.constants[i];
            if (c.wide) std::fill_n((u64*)(w.file + c.at), 32, c.value);
            else std::fill_n((u32*)(w.file + c.at), 32, (u32)c.value);
            w.lanes_known(c.at) = ~0u;
        }
        for (u32 l = 0; l < 32; l++) {
            u32 special[14];
            u64 thread = first + l, of_grid = block;
            for (int k = 0; k < 3; k++) {
                special[k] = thread % L.threads[k], special[3 + k] = L.threads[k];
                special[6 + k] = of_grid % L.blocks[k], special[9 + k] = L.blocks[k];
                thread /= L.threads[k], of_grid /= L.blocks[k];
            }
            special[12] = l, special[13] = (1u << l) - 1;
            for (int k = 0; k < 14; k++)
                if (L.special[k] >= 0) w.slot<u32>(L.special[k], l) = special[k];
        }
        for (s64 r : L.special)
            if (r >= 0) w.lanes_known(r) = ~0u;
    }

    // All warps stand at a barrier of the block, or are gone: they go on.
    void release() {
        u32 at = ~0u, set = 0;
        for (auto& w : warps)
            for (auto& f : w.fragments)
                if (L.code[f.at].writes) {
                    demand(w, L.code[f.at].given[0], f.lanes, f.at);
                    set += __builtin_popcount(set_lanes(w, L.code[f.at].given[0]) & f.lanes);
                }
        for (auto& w : warps) {
            u32 there = 0;
            for (auto& f : w.fragments) {
                if (at == ~0u) at = f.at;
                if (f.at != at) report(DIVERGENT, f.at, w.index * 32);
                there |= f.lanes;
            }
            if (there != w.live) report(DIVERGENT, at, w.index * 32);
            std::vector<Fragment> waiting;
            waiting.swap(w.fragments);
            for (auto& f : waiting) {
                if (L.code[f.at].writes) {
                    EACH(l, f.lanes) w.slot<u32>(L.code[f.at].to[0], l) = set;
                    w.lanes_known(L.code[f.at].to[0]) |= f.lanes;
                }
                Fragment next = {f.at + 1, f.lanes, READY};
                meet(w, next, READY);
                w.fragments.push_back(next);
            }
        }
        barriers++;
    }

    void run_block(s64 number) {
        block = number;
        barriers++;
        shared_tag = ++tags;
        std::fill(shared.begin(), shared.end(), 0xFF);
        std::fill(local.begin(), local.end(), 0xFF);
        std::fill(local_known.begin(), local_known.end(), 0);
        for (auto& w : warps) begin(w);
        std::vector<int> order(warps.size());
        std::iota(order.begin(), order.end(), 0);
        while (!stop) {
            if (drawn) std::shuffle(order.begin(), order.end(), draw);
            for (int i : order) run_warp(warps[i], drawn ? 1 + draw() % 40 : -1);
            bool there[3] = {};
            for (auto& w : warps)
                for (auto& f : w.fragments) there[f.state] = true;
            if (there[READY]) continue;
            if (there[AT_WARP]) {
                for (auto& w : warps)
                    for (auto& f : w.fragments)
                        if (f.state == AT_WARP)
                            report(DEADLOCK, f.at, w.index * 32 + __builtin_ctz(f.lanes));
                stop = true;
            }
            if (!there[AT_BLOCK]) break;
            release();
        }
        for (auto& w : warps) L.steps += w.steps;
    }
};

extern "C" {
const char* opcode_name(int i) { return i < COUNT ? OPCODES[i].name : nullptr; }
const char* opcode_unit(int i) { return OPCODES[i].unit; }
const char* opcode_operands(int i) { return OPCODES[i].operands; }
int opcode_writes(int i) { return OPCODES[i].writes; }

void run(Launch* L) {
    std::fenv_t before;  // the process may take numbers below the normal ones for 0; PTX does not
    std::fegetenv(&before);
    std::fesetenv(FE_DFL_ENV);
    approximate = L->approximate;
    Machine machine(*L);
    std::vector<s64> order(L->blocks[0] * L->blocks[1] * L->blocks[2]);
    std::iota(order.begin(), order.end(), 0);
    if (L->seed) std::shuffle(order.begin(), order.end(), machine.draw);
    for (s64 block : order)
        if (!machine.stop) machine.run_block(block);
    std::fesetenv(&before);
}
}
