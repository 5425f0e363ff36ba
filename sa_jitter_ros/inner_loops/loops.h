// Copyright 2026 sa_jitter_ros contributors
//
// Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
// in compliance with the License. You may obtain a copy of the License at
// http://www.apache.org/licenses/LICENSE-2.0
// Unless required by applicable law or agreed to in writing, software distributed under the License
// is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
// or implied. See the License for the specific language governing permissions and limitations under
// the License.

/* The loops over all samples, with vectors of `LANES` numbers and names that are `NAMED(...)`.
 *
 * _in_c.c includes this once for each width of vectors, which are no wider than the registers.
 */

/* Neighbouring numbers, at any address. */
#define vector NAMED(vector)
typedef double vector __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
typedef int64_t NAMED(lanes) __attribute__((vector_size(8 * LANES)));
#ifndef INLINE
#define INLINE static inline __attribute__((always_inline))
typedef double four __attribute__((vector_size(32), aligned(8), may_alias));
typedef double two __attribute__((vector_size(16), aligned(8), may_alias));
typedef double one __attribute__((may_alias));
#endif

INLINE double NAMED(total)(vector sum)
{
    for (int width = LANES / 2; width > 0; width /= 2)
        for (int k = 0; k < width; k++)
            sum[k] += sum[k + width];
    return sum[0];
}

/* --- weighted sums --- */

#ifndef ADD_UP
/* The sums of some neighbouring channels, in four parts that do not wait for each other. */
#define ADD_UP(type) do { \
    const type zero = {0.0}; \
    type sum[4] = {zero, zero, zero, zero}; \
    const double *row = first + c; \
    Py_ssize_t k = 0; \
    for (; k + 4 <= taps; k += 4, row += 4 * channels) { \
        sum[0] += weights[k] * *(const type *)row; \
        sum[1] += weights[k + 1] * *(const type *)(row + channels); \
        sum[2] += weights[k + 2] * *(const type *)(row + 2 * channels); \
        sum[3] += weights[k + 3] * *(const type *)(row + 3 * channels); \
    } \
    for (; k < taps; k++, row += channels) \
        sum[0] += weights[k] * *(const type *)row; \
    *(type *)(values + c) = (sum[0] + sum[1]) + (sum[2] + sum[3]); \
} while (0)

/* Samples from the first of a sum to what is fetched from the memory, which takes that long. */
#define AHEAD 64
#endif

/* `table` holds the polynomials of the first half of the weights, the lowest power first, in rows
 * of `width` numbers that begin at a multiple of 64 bytes: zeros and the `half`; `room` is that of
 * the weights between as many zeros. Weights of the second half are those of the first, in the
 * other order, with the odd powers taken away. Returns 0 if a sum is not within the samples, of
 * which it may begin at the `last`. */
INLINE int NAMED(sums)(const double *samples, const Py_ssize_t channels, Py_ssize_t last,
                       const struct places *at, const double *restrict table,
                       double *restrict room, const Py_ssize_t order, const Py_ssize_t half,
                       double *restrict values)
{
    typedef double aligned __attribute__((vector_size(8 * LANES), may_alias));
    NAMED(lanes) turned;
    for (int k = 0; k < LANES; k++)
        turned[k] = LANES - 1 - k;
    const Py_ssize_t width = (half + 7) / 8 * 8;
    const double *weights = room + width - half;
    const struct places p = *at;
    const Py_ssize_t size = p.rows * p.count, taps = 2 * half;
    for (Py_ssize_t i = 0, row = 0, column = 0; i < size; i++, values += channels) {
        const double place = p.begin[row] + p.length[row] * p.u[column];
        if (!(place >= 0.0 && place <= INT32_MAX))
            return 0;
        const int32_t whole = (int32_t)place;
        const Py_ssize_t index = p.origin[row] + (Py_ssize_t)whole;
        if (index < 0 || index > last)
            return 0;
        if (++column == p.count) {
            column = 0;
            row++;
        }
        const double *first = samples + index * channels;
        const double x = 2.0 * (place - whole) - 1.0, square = x * x;
        Py_ssize_t t, c = 0;
        for (t = 0; t < width; t += LANES) {
            const double *power = table + (order - 2) * width + t;
            vector even = *(const aligned *)power, odd = *(const aligned *)(power + width);
            for (Py_ssize_t k = order - 2; k > 0; k -= 2) {
                power -= 2 * width;
                even = even * square + *(const aligned *)power;
                odd = odd * square + *(const aligned *)(power + width);
            }
            odd *= x;
            const vector second = even - odd;
            *(aligned *)(room + t) = even + odd;
            *(aligned *)(room + 2 * width - LANES - t) = __builtin_shuffle(second, turned);
        }
        if (channels == 1) {
            vector sum = {0.0};
            for (t = 0; t + LANES <= taps; t += LANES)
                sum += *(const vector *)(weights + t) * *(const vector *)(first + t);
            for (; t < taps; t++)
                sum[t % LANES] += weights[t] * first[t];
            *values = NAMED(total)(sum);
            continue;
        }
        for (; c + LANES <= channels; c += LANES) {
            if (c % 8 == 0)
                __builtin_prefetch(first + AHEAD * channels + c);
            ADD_UP(vector);
        }
#if LANES > 4
        for (; c + 4 <= channels; c += 4)
            ADD_UP(four);
#endif
#if LANES > 2
        for (; c + 2 <= channels; c += 2)
            ADD_UP(two);
#endif
        for (; c < channels; c++)
            ADD_UP(one);
    }
    return 1;
}

/* What is known to the compiler stays in registers: the default interpolator, one channel. */
static int NAMED(weighted_sums)(const double *samples, Py_ssize_t channels, Py_ssize_t last,
                                const struct places *at, const double *table, double *room,
                                Py_ssize_t order, Py_ssize_t half, double *values)
{
    if (order == 8 && half == 8 && channels == 1)
        return NAMED(sums)(samples, 1, last, at, table, room, 8, 8, values);
    if (order == 8 && half == 8)
        return NAMED(sums)(samples, channels, last, at, table, room, 8, 8, values);
    return NAMED(sums)(samples, channels, last, at, table, room, order, half, values);
}

/* --- frames --- */

/* Which of the numbers of two rows go to the first: of blocks of `size`, every other one of both. */
#define FROM(k, size) ((k) & (size) ? LANES + (k) - (size) : (k))
#if LANES == 8
#define FIRST(size) {FROM(0, size), FROM(1, size), FROM(2, size), FROM(3, size), \
                     FROM(4, size), FROM(5, size), FROM(6, size), FROM(7, size)}
#elif LANES == 4
#define FIRST(size) {FROM(0, size), FROM(1, size), FROM(2, size), FROM(3, size)}
#else
#define FIRST(size) {FROM(0, size), FROM(1, size)}
#endif

INLINE void NAMED(exchange)(vector *row, const int size, const NAMED(lanes) first)
{
    for (int k = 0; k < LANES; k++)
        if (!(k & size)) {
            const vector one = row[k], other = row[k + size];
            row[k] = __builtin_shuffle(one, other, first);
            row[k + size] = __builtin_shuffle(one, other, first + size);
        }
}

/* As many samples of as many channels. */
INLINE void NAMED(transpose)(vector *row)
{
    NAMED(exchange)(row, 1, (NAMED(lanes))FIRST(1));
    if (LANES > 2)
        NAMED(exchange)(row, 2, (NAMED(lanes))FIRST(2));
    if (LANES > 4)
        NAMED(exchange)(row, 4, (NAMED(lanes))FIRST(4));
}

/* Steps are in bytes. What is not finite makes the sum of 0 times all numbers NaN. */
static int NAMED(frames)(const char *samples, Py_ssize_t channels, Py_ssize_t count,
                         Py_ssize_t channel_step, Py_ssize_t step, double *values)
{
    const Py_ssize_t many = step == sizeof(double) ? channels / LANES * LANES : 0, tile = 2048;
    vector zero = {0.0}, row[LANES];
    double sum = 0.0;
    for (Py_ssize_t begin = 0; begin < count; begin += tile) {
        const Py_ssize_t end = begin + tile < count ? begin + tile : count;
        for (Py_ssize_t c = 0; c < channels; c += c < many ? LANES : 1) {
            const char *first = samples + c * channel_step;
            Py_ssize_t s = begin;
            for (; c < many && s + LANES <= end; s += LANES) {
                for (int k = 0; k < LANES; k++) {
                    row[k] = *(const vector *)(first + k * channel_step + s * step);
                    zero += row[k] * 0.0;
                }
                NAMED(transpose)(row);
                for (int k = 0; k < LANES; k++)
                    *(vector *)(values + (s + k) * channels + c) = row[k];
            }
            for (Py_ssize_t k = 0; k < (c < many ? LANES : 1); k++)
                for (Py_ssize_t t = s; t < end; t++) {
                    const double value = *(const double *)(first + k * channel_step + t * step);
                    values[t * channels + c + k] = value;
                    sum += value * 0.0;
                }
        }
    }
    return sum + NAMED(total)(zero) == 0.0;
}

/* Samples that are in the order of frames. */
static int NAMED(copied)(const double *samples, Py_ssize_t count, double *values)
{
    vector zero = {0.0};
    Py_ssize_t i = 0;
    for (; i + LANES <= count; i += LANES) {
        const vector part = *(const vector *)(samples + i);
        *(vector *)(values + i) = part;
        zero += part * 0.0;
    }
    for (; i < count; i++) {
        values[i] = samples[i];
        zero[0] += samples[i] * 0.0;
    }
    return NAMED(total)(zero) == 0.0;
}

/* --- add steps --- */

#ifndef ADD_STEPS
#define ADD_STEPS(type) do { \
    const type begin = *(const type *)(first + i); \
    type step = {0.0}, total = step, power = step; \
    for (Py_ssize_t k = 0; k < count; k++) { \
        step = *(const type *)(values + k * apart + i * sizeof(double)) - begin; \
        total += step; \
        power += step * step; \
    } \
    *(type *)(sum + i) += total; \
    *(type *)(squares + i) += power; \
} while (0)
#endif

/* The arrays are `apart` bytes from each other. */
static void NAMED(add_steps)(const char *values, Py_ssize_t count, Py_ssize_t apart,
                             Py_ssize_t size, const double *first, double *sum, double *squares)
{
    Py_ssize_t i = 0;
    for (; i + LANES <= size; i += LANES)
        ADD_STEPS(vector);
    for (; i < size; i++)
        ADD_STEPS(one);
}

/* --- add products --- */

/* Some lines of the table; the compiler knows how many, and keeps their sums in registers. */
INLINE void NAMED(some_lines)(const int lines, const double *table, Py_ssize_t apart,
                              Py_ssize_t rows, const double *values, Py_ssize_t size,
                              double *sums)
{
    Py_ssize_t i = 0;
    for (; i + 2 * LANES <= size; i += 2 * LANES) {
        vector sum[6][2];
        for (int j = 0; j < lines; j++)
            for (int h = 0; h < 2; h++)
                sum[j][h] = *(const vector *)(sums + j * size + i + LANES * h);
        for (Py_ssize_t r = 0; r < rows; r++)
            for (int h = 0; h < 2; h++) {
                const vector value = *(const vector *)(values + r * size + i + LANES * h);
                for (int j = 0; j < lines; j++)
                    sum[j][h] += table[j * apart + r] * value;
            }
        for (int j = 0; j < lines; j++)
            for (int h = 0; h < 2; h++)
                *(vector *)(sums + j * size + i + LANES * h) = sum[j][h];
    }
    for (; i < size; i++)
        for (Py_ssize_t r = 0; r < rows; r++)
            for (int j = 0; j < lines; j++)
                sums[j * size + i] += table[j * apart + r] * values[r * size + i];
}

/* The lines of the table are `apart` numbers from each other. */
static void NAMED(add_products)(const double *table, Py_ssize_t lines, Py_ssize_t apart,
                                Py_ssize_t rows, const double *values, Py_ssize_t size,
                                double *sums)
{
    for (; lines >= 6; lines -= 6, table += 6 * apart, sums += 6 * size)
        NAMED(some_lines)(6, table, apart, rows, values, size, sums);
    for (; lines >= 2; lines -= 2, table += 2 * apart, sums += 2 * size)
        NAMED(some_lines)(2, table, apart, rows, values, size, sums);
    if (lines)
        NAMED(some_lines)(1, table, apart, rows, values, size, sums);
}

static const struct loops NAMED(loops) = {
    LANES, NAMED(weighted_sums), NAMED(frames), NAMED(copied), NAMED(add_steps),
    NAMED(add_products)};

#undef FROM
#undef FIRST
#undef vector
#undef NAMED
#undef LANES
