/* OpenEXR's ZIP, done and undone for many chunks of a picture, without Python in between.
 *
 * Before a chunk is deflated its bytes are sorted, those at even places before those at odd ones,
 * and each but the first is stored as its difference to the one before, plus 128. To add them up
 * again is a running sum of bytes, for which numpy has no fast way. OpenEXR as it is built for
 * Python goes byte by byte, both ways.
 */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

/* What is added up over so many bytes: the sum of their differences, without the 128 of each. */
static uint8_t total(const uint8_t *bytes, Py_ssize_t size)
{
    uint8_t sum = 0;
    Py_ssize_t at = 0;
#ifdef __SSE2__
    __m128i sums = _mm_setzero_si128();
    for (; at + 16 <= size; at += 16)
        sums = _mm_add_epi8(sums, _mm_loadu_si128((const __m128i *)(bytes + at)));
    /* Sixteen times 128 is nothing to a byte. */
    sums = _mm_sad_epu8(sums, _mm_setzero_si128());
    sum = (uint8_t)(_mm_cvtsi128_si32(sums) + _mm_extract_epi16(sums, 4));
#endif
    for (; at < size; at++)
        sum = (uint8_t)(sum + bytes[at] - 128);
    return sum;
}

#ifdef __SSE2__
/* Eight pairs of bytes added up, from what comes before them on. */
static inline __m128i added_up(__m128i pairs, __m128i *before)
{
    pairs = _mm_add_epi8(pairs, _mm_slli_si128(pairs, 2));
    pairs = _mm_add_epi8(pairs, _mm_slli_si128(pairs, 4));
    pairs = _mm_add_epi8(pairs, _mm_slli_si128(pairs, 8));
    __m128i result = _mm_add_epi8(pairs, *before);
    /* The last of them in every place. Only one addition waits for the round before. */
    pairs = _mm_shufflehi_epi16(pairs, 0xFF);
    *before = _mm_add_epi8(*before, _mm_unpackhi_epi64(pairs, pairs));
    return result;
}
#endif

/* The bytes of a chunk as they were: both halves added up, and put at even and odd places. */
static void restore(const uint8_t *sorted, uint8_t *target, Py_ssize_t size)
{
    Py_ssize_t pairs = size / 2, at = 0;
    const uint8_t *even = sorted, *odd = sorted + (size + 1) / 2;
    /* One half goes on where the other ends. */
    uint8_t last_even = 128, last_odd = (uint8_t)(128 + total(even, (size + 1) / 2));
#ifdef __SSE2__
    /* What comes before, and the 128 of each difference: an odd number of them in every other
     * place, and of eight pairs nothing. */
    __m128i before = _mm_set1_epi16((int16_t)(last_even | last_odd << 8));
    before = _mm_xor_si128(before, _mm_set1_epi32(0x8080));
    for (; at + 16 <= pairs; at += 16) {
        __m128i first = _mm_loadu_si128((const __m128i *)(even + at));
        __m128i second = _mm_loadu_si128((const __m128i *)(odd + at));
        __m128i *place = (__m128i *)(target + 2 * at);
        _mm_storeu_si128(place, added_up(_mm_unpacklo_epi8(first, second), &before));
        _mm_storeu_si128(place + 1, added_up(_mm_unpackhi_epi8(first, second), &before));
    }
    last_even = (uint8_t)(_mm_extract_epi16(before, 1) & 0xFF);
    last_odd = (uint8_t)(_mm_extract_epi16(before, 1) >> 8);
#endif
    for (; at < pairs; at++) {
        target[2 * at] = last_even = (uint8_t)(last_even + even[at] - 128);
        target[2 * at + 1] = last_odd = (uint8_t)(last_odd + odd[at] - 128);
    }
    if (size % 2)
        target[size - 1] = (uint8_t)(last_even + even[pairs] - 128);
}

/* OpenEXR's exr_uncompress_buffer: context, source, target, and how much came of it. */
typedef int32_t (*inflate_t)(const void *, const void *, size_t, void *, size_t, size_t *);

/* Which rows a picture has, and how they lie in a file. */
typedef struct {
    int32_t top;       /* the number of the first row */
    Py_ssize_t rows;   /* in a chunk */
    Py_ssize_t length; /* bytes of a row */
} layout_t;

/* How many chunks from the first on are whole, and where they should be. */
static Py_ssize_t unzip(inflate_t inflate, const Py_buffer *data, const Py_buffer *table,
                        const Py_buffer *target, const layout_t *layout, uint8_t *scratch)
{
    const uint8_t *file = data->buf;
    Py_ssize_t chunks = table->len / 8, size = layout->rows * layout->length, chunk;
    for (chunk = 0; chunk < chunks && chunk * size < target->len; chunk++) {
        /* Its place in the file; there, the number of its first row and how much is stored. */
        uint64_t start;
        int32_t number, stored;
        memcpy(&start, (const uint8_t *)table->buf + 8 * chunk, 8);
        if (data->len < 8 || start > (uint64_t)data->len - 8)
            return chunk;
        memcpy(&number, file + start, 4);
        memcpy(&stored, file + start + 4, 4);
        start += 8;
        if (number != layout->top + chunk * layout->rows || stored < 1 ||
            (uint64_t)stored > (uint64_t)data->len - start)
            return chunk;
        uint8_t *bytes = (uint8_t *)target->buf + chunk * size;
        Py_ssize_t left = target->len - chunk * size, expected = left < size ? left : size;
        size_t inflated = 0;
        if (stored == expected) {
            memcpy(bytes, file + start, (size_t)expected);
            continue;
        }
        if (!inflate ||
            inflate(NULL, file + start, (size_t)stored, scratch, (size_t)expected, &inflated) ||
            inflated != (size_t)expected)
            return chunk;
        restore(scratch, bytes, expected);
    }
    return chunk;
}

/* The bytes of a chunk as they are deflated: sorted, and but for the first as differences. */
static void arrange(const uint8_t *bytes, uint8_t *sorted, Py_ssize_t size)
{
    Py_ssize_t pairs = size / 2, at;
    uint8_t *even = sorted, *odd = sorted + (size + 1) / 2;
    for (at = 1; at < pairs; at++) {
        even[at] = (uint8_t)(bytes[2 * at] - bytes[2 * at - 2] + 128);
        odd[at] = (uint8_t)(bytes[2 * at + 1] - bytes[2 * at - 1] + 128);
    }
    if (size % 2 && size > 1)
        even[pairs] = (uint8_t)(bytes[size - 1] - bytes[size - 3] + 128);
    even[0] = bytes[0];
    if (pairs)
        odd[0] = (uint8_t)(bytes[1] - bytes[size - 1 - (size + 1) % 2] + 128);
}

/* OpenEXR's exr_compress_buffer: context, level, source, target, and how much came of it. */
typedef int32_t (*deflate_t)(const void *, int, const void *, size_t, void *, size_t, size_t *);

/* Deflate rows, and note where in the target each chunk starts: the end of the last; -1 if there is
 * no room for them, or for where they start. What deflating makes no smaller is stored as it is. */
static Py_ssize_t zip(deflate_t deflate, int level, const Py_buffer *source, Py_buffer *target,
                      Py_ssize_t place, Py_buffer *table, const layout_t *layout, uint8_t *scratch)
{
    const uint8_t *rows = source->buf;
    uint8_t *file = target->buf;
    Py_ssize_t chunks = table->len / 8, size = layout->rows * layout->length, chunk;
    for (chunk = 0; chunk * size < source->len; chunk++) {
        Py_ssize_t left = source->len - chunk * size, own = left < size ? left : size;
        uint64_t start = (uint64_t)place;
        int32_t number = (int32_t)(layout->top + chunk * layout->rows), stored = (int32_t)own;
        size_t deflated = 0;
        if (chunk == chunks || target->len - place < 8 + own)
            return -1;
        arrange(rows + chunk * size, scratch, own);
        place += 8;
        if (deflate(NULL, level, scratch, (size_t)own, file + place,
                    (size_t)(target->len - place), &deflated))
            return -1;
        if (deflated < (size_t)own)
            stored = (int32_t)deflated;
        else
            memcpy(file + place, rows + chunk * size, (size_t)own);
        memcpy((uint8_t *)table->buf + 8 * chunk, &start, 8);
        memcpy(file + start, &number, 4);
        memcpy(file + start + 4, &stored, 4);
        place += stored;
    }
    return place;
}

/* Room for a chunk, or for as much of one as there is; NULL with an error set. */
static uint8_t *room_for(const layout_t *layout, Py_ssize_t there)
{
    if (layout->rows < 1 || layout->length < 1) {
        PyErr_SetString(PyExc_ValueError, "chunks without rows, or rows without bytes");
        return NULL;
    }
    if (layout->length > PY_SSIZE_T_MAX / layout->rows) {
        PyErr_SetString(PyExc_ValueError, "chunks of more bytes than there are");
        return NULL;
    }
    Py_ssize_t size = layout->rows * layout->length;
    /* One byte more, as of nothing there may be no memory. */
    uint8_t *room = malloc((size_t)(size < there ? size : there) + 1);
    if (!room)
        PyErr_NoMemory();
    return room;
}

static PyObject *py_unzip(PyObject *module, PyObject *arguments)
{
    PyObject *address;
    Py_buffer data, table, target;
    layout_t layout;
    Py_ssize_t done = 0;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!y*y*w*inn", &PyLong_Type, &address, &data, &table, &target,
                          &layout.top, &layout.rows, &layout.length))
        return NULL;
    inflate_t inflate = (inflate_t)PyLong_AsVoidPtr(address);
    uint8_t *scratch = PyErr_Occurred() ? NULL : room_for(&layout, target.len);
    if (scratch) {
        Py_BEGIN_ALLOW_THREADS
        done = unzip(inflate, &data, &table, &target, &layout, scratch);
        Py_END_ALLOW_THREADS
    }
    free(scratch);
    PyBuffer_Release(&data);
    PyBuffer_Release(&table);
    PyBuffer_Release(&target);
    return PyErr_Occurred() ? NULL : PyLong_FromSsize_t(done);
}

static PyObject *py_zip(PyObject *module, PyObject *arguments)
{
    PyObject *address;
    Py_buffer rows, target, table;
    layout_t layout;
    Py_ssize_t place, end = 0;
    int level;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!iy*w*nw*inn", &PyLong_Type, &address, &level, &rows,
                          &target, &place, &table, &layout.top, &layout.rows, &layout.length))
        return NULL;
    deflate_t deflate = (deflate_t)PyLong_AsVoidPtr(address);
    uint8_t *scratch = PyErr_Occurred() ? NULL : room_for(&layout, rows.len);
    if (scratch) {
        if (deflate && place >= 0 && place <= target.len) {
            Py_BEGIN_ALLOW_THREADS
            end = zip(deflate, level, &rows, &target, place, &table, &layout, scratch);
            Py_END_ALLOW_THREADS
        } else {
            PyErr_SetString(PyExc_ValueError, "nothing that deflates, or no place in the target");
        }
    }
    free(scratch);
    PyBuffer_Release(&rows);
    PyBuffer_Release(&target);
    PyBuffer_Release(&table);
    return PyErr_Occurred() ? NULL : PyLong_FromSsize_t(end);
}

static PyMethodDef methods[] = {
    {"unzip", py_unzip, METH_VARARGS,
     "unzip(inflate, data, table, target, top, rows, length): how many chunks from the first on\n"
     "are whole.\n\n"
     "inflate is the address of OpenEXR's exr_uncompress_buffer, or 0 for chunks that are stored\n"
     "as they are; table holds each one's place in data as uint64. Into target go rows of so many\n"
     "bytes, so many of them from each chunk; the first has the number top."},
    {"zip", py_zip, METH_VARARGS,
     "zip(deflate, level, source, target, place, table, top, rows, length): the place after the\n"
     "last chunk, -1 if target or table has no room for them, or there is no memory.\n\n"
     "deflate is the address of OpenEXR's exr_compress_buffer. source holds rows of so many bytes,\n"
     "of which so many go to each chunk; the first has the number top. Chunks are written to target\n"
     "from a place on, and where each starts to table, as uint64."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_zip", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__zip(void)
{
    return PyModule_Create(&definition);
}
