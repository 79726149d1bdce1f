local protocol, format = Proto(GRAMMAR.word, GRAMMAR.title), string.format
local US, MS = 1000, 1000000 -- ns
local WIDEST = 6 -- bytes of a number: those of Lua are exact up to 2^53
protocol.prefs.take = Pref.bool("Take every RTAC serial packet", true,
    "Off: they are shown as without this script")
protocol.prefs.truncation_timeout = Pref.uint("Truncation time-out in us",
    GRAMMAR.truncation_timeout, "A longer pause inside a frame ends it")
protocol.prefs.skew = Pref.uint("Skew of the taps in us", GRAMMAR.skew,
    "So long before its instruction a response may be stamped")

-- What an item may have besides its bytes, in the order in which it is shown.
local CODES = not GRAMMAR.flags and GRAMMAR.codes or nil
local GENERATED = {
    { word = "name", kind = "STRING", name = "Name" },
    { word = "kind", kind = "STRING", name = "Kind" },
    { word = "outcome", kind = "STRING", name = "Outcome" },
    { word = "check_good", kind = "BOOLEAN", name = "The check is right" },
    { word = "response_to", kind = "FRAMENUM", name = "Response to", names = frametype.REQUEST },
    { word = "latency", kind = "RELATIVE_TIME", name = "Latency",
        prose = "Time from the instruction's last byte to its response" },
    { word = "agrees", kind = "BOOLEAN", name = "Is the expected response" },
    { word = "judgement", kind = "UINT32", name = "A conforming device says", names = CODES },
    { word = "reason", kind = "STRING", name = "Reason" },
    { word = "sequence", kind = "UINT32", name = "Number of the instruction" },
    { word = "begins_in", kind = "FRAMENUM", name = "Begins in" },
    { word = "goes_on_in", kind = "FRAMENUM", name = "Goes on in" },
    { word = "cut_short", kind = "FRAMENUM", name = "Cut short is the frame in" },
    { word = "response_in", kind = "FRAMENUM", name = "Response in", names = frametype.RESPONSE },
}
local DATA = { word = "data", kind = "BYTES", name = "Data" }
local MOVING = { word = "state.moving", kind = "BOOLEAN", name = "moving" }

-- Declaring the fields. Those of one word hold the same kind of value.

local fields, kind_of = {}, {}

local function declare(row, word, kind)
    local class = kind:match("INT") or kind
    while kind_of[word] and kind_of[word] ~= class do word = word .. "_" end
    kind_of[word] = class
    local shape = row.within or kind:find("INT") and base.DEC or base.NONE
    if row.role == "check" and class == "INT" then shape = base.HEX end
    row.field = ProtoField.new(row.name ~= "" and row.name or "constant",
        GRAMMAR.word .. "." .. word, ftypes[kind], row.names or nil, shape, row.mask, row.prose)
    fields[#fields + 1] = row.field
end

local function declare_value(row, word)
    local size = row.count and row.width or row.size
    row.raw = string.char((table.unpack or unpack)(row.constant))
    row.bytes = #row.raw > 0 or not row.order or size > WIDEST
    if row.bytes then return declare(row, word, "BYTES") end
    declare(row, word, (row.signed and "INT" or "UINT") .. (size <= 4 and 8 * size or 64))
    for _, bit in ipairs(row.bits or {}) do
        bit.within, bit.names = 8 * size, { "on", "off" }
        declare(bit, word .. "." .. bit.word, "BOOLEAN")
    end
end

local LAYOUTS = { GRAMMAR.frame, GRAMMAR.reply, GRAMMAR.ack }
for _, layout in ipairs(GRAMMAR.errors) do table.insert(LAYOUTS, layout) end
for _, layout in ipairs(LAYOUTS) do
    for _, part in ipairs(layout.parts) do
        if part.width > 0 then part.mask = (2 ^ part.width - 1) * 2 ^ part.shift end
        if part.role == "code" then part.names = CODES end
        if part.role == "id" and part.same == "" then part.names = GRAMMAR.ids end
        declare_value(part, part.word)
    end
end
for _, spec in pairs(GRAMMAR.instructions) do
    for _, row in ipairs(spec.fields) do declare_value(row, spec.word .. "." .. row.word) end
    for _, row in ipairs(spec.answer or {}) do
        declare_value(row, spec.word .. ".answer." .. row.word)
    end
end
for _, rows in ipairs({ GRAMMAR.state, GENERATED, { DATA, MOVING } }) do
    for _, row in ipairs(rows) do declare(row, row.word, row.kind) end
end
protocol.fields = fields

local X = {}
for word, row in pairs({
    faulty = { "Faulty instruction", "PROTOCOL", "WARN" },
    truncated = { "Truncated instruction", "MALFORMED", "WARN" },
    garbage = { "Bytes that belong to no frame", "UNDECODED", "WARN" },
    damaged = { "Damaged response", "MALFORMED", "WARN" },
    disagreeing = { "Not the expected response", "RESPONSE_CODE", "WARN" },
    unused = { "Unused response", "RESPONSE_CODE", "ERROR" },
    late = { "Late response", "SEQUENCE", "WARN" },
    unanswered = { "No response", "SEQUENCE", "WARN" },
    unsolicited = { "Responds to no instruction", "SEQUENCE", "WARN" },
}) do
    X[word] = ProtoExpert.new(GRAMMAR.word .. ".expert." .. word, row[1], expert.group[row[2]],
        expert.severity[row[3]])
end
protocol.experts = X

-- Checks, by arithmetic: not every Lua has signs for bits.

local function bxor(a, b)
    local value, bit = 0, 1
    while a > 0 or b > 0 do
        local x, y = a % 2, b % 2
        if x ~= y then value = value + bit end
        a, b, bit = (a - x) / 2, (b - y) / 2, bit * 2
    end
    return value
end

local function band(a, b)
    return (a + b - bxor(a, b)) / 2
end

local function mirrored(value, width)
    local turned = 0
    for _ = 1, width do
        turned, value = turned * 2 + value % 2, math.floor(value / 2)
    end
    return turned
end

local function set_up(check) -- the register of a Crc: it holds a byte at least
    check.bits = check.reflected and check.width or math.max(check.width, 8)
    check.spare = 2 ^ (check.bits - check.width)
    check.start = check.reflected and mirrored(check.init, check.width) or check.init * check.spare
end

local function crc_table(check) -- what each value of the byte that leaves the register adds to it
    local made, top = {}, 2 ^ (check.bits - 1)
    local poly = check.reflected and mirrored(check.poly, check.width) or check.poly * check.spare
    for byte = 0, 255 do
        local value = check.reflected and byte or byte * 2 ^ (check.bits - 8)
        for _ = 1, 8 do
            local out = check.reflected and value % 2 == 1 or not check.reflected and value >= top
            value = check.reflected and math.floor(value / 2) or value * 2 % (top * 2)
            if out then value = bxor(value, poly) end
        end
        made[byte] = value
    end
    return made
end

local FUNCTIONS = {
    Sum = function(check, bytes)
        local total, whole = 0, 2 ^ check.bits
        local complement = check.complement == true and 1 or check.complement or 0
        for i = 1, #bytes do total = total + bytes:byte(i) end
        if complement > 0 then total = complement - 2 - total end
        return total % whole
    end,
    Fletcher = function(check, bytes)
        local first, second = 0, 0
        for i = 1, #bytes do
            first = (first + bytes:byte(i)) % check.modulus
            second = (second + first) % check.modulus
        end
        return second * 256 + first
    end,
    Xor = function(check, bytes)
        local value = check.start
        for i = 1, #bytes do value = bxor(value, bytes:byte(i)) end
        return value
    end,
    Crc = function(check, bytes)
        if not check.table then
            set_up(check)
            check.table = crc_table(check)
        end
        local value, over = check.start, 2 ^ (check.bits - 8)
        for i = 1, #bytes do
            if check.reflected then
                value = bxor(math.floor(value / 256), check.table[bxor(value % 256, bytes:byte(i))])
            else
                local leaves = bxor(math.floor(value / over), bytes:byte(i))
                value = bxor(value % over * 256, check.table[leaves])
            end
        end
        value = math.floor(value / check.spare)
        if check.refout ~= check.reflected then value = mirrored(value, check.width) end
        return bxor(value, check.xorout)
    end,
}

local function covered(layout, bytes)
    local check = layout.check
    local first, behind = layout.first or 0, 0
    if check then first, behind = check.first, check.last end
    return bytes:sub(1 + first, #bytes - behind)
end

-- Reading what stands in a frame.

local function hex(bytes)
    return (bytes:gsub(".", function(char) return format(" %02x", char:byte()) end):sub(2))
end

local function number_at(row, size, bytes, at)
    local value = 0
    for i = 1, size do
        value = value * 256 + bytes:byte(at + (row.order == "little" and size + 1 - i or i))
    end
    return row.signed and value >= 256 ^ size / 2 and value - 256 ^ size or value
end

local function place_of(part, bytes)
    return part.offset < 0 and #bytes + part.offset or part.offset
end

local function raw_of(part, bytes)
    local at = place_of(part, bytes)
    return bytes:sub(at + 1, at + part.size)
end

local function read(part, bytes)
    local value = number_at(part, part.size, bytes, place_of(part, bytes))
    if part.width > 0 then value = math.floor(value / 2 ^ part.shift) % 2 ^ part.width end
    return value - part.also
end

local function part_of(layout, role)
    for _, part in ipairs(layout.parts) do
        if part.role == role then return part end
    end
end

local function value_of(layout, role, bytes)
    local part = part_of(layout, role)
    return part and read(part, bytes)
end

local function wrong_constant(layout, bytes)
    for _, part in ipairs(layout.parts) do
        local found = raw_of(part, bytes)
        if #part.raw > 0 and found ~= part.raw then
            return format("%s stands where %s must be", hex(found), hex(part.raw))
        end
    end
    for _, part in ipairs(layout.parts) do
        if part.role == "constant" and part.width > 0 and read(part, bytes) ~= part.low then
            return format("%s is %.0f, right is %.0f", part.name ~= "" and part.name or "a constant",
                read(part, bytes), part.low)
        end
    end
end

local function wrong_check(layout, bytes, before) -- and whether it is right, where there is one
    local check = layout.check
    if not check then return nil, nil end
    local counted = (check.asked and before or "") .. covered(layout, bytes)
    local right, part = FUNCTIONS[check.kind](check, counted), part_of(layout, "check")
    if read(part, bytes) == right then return nil, true end
    local due = {}
    for i = 1, part.size do
        local place = part.order == "little" and i or part.size + 1 - i
        due[place], right = format("%02x", right % 256), math.floor(right / 256)
    end
    return format("%s is %s, right is %s", part.name, hex(raw_of(part, bytes)),
        table.concat(due, " ")), false
end

local function counted(count, what)
    return format(count == 1 and "%.0f %s" or "%.0f %ss", count, what)
end

-- How many bytes data have that begin so; all where only the frame or a number before counts them.
local function measured(rows, data)
    local last = rows[#rows]
    if not last then return 0 end
    if last.count == "bytes in front" or last.count == "elements in front" then
        if #data < last.offset + last.prefix then return last.offset + last.prefix end
        local count = number_at({ order = last.prefix_order }, last.prefix, data, last.offset)
        local each = last.count == "bytes in front" and 1 or last.width
        return last.offset + last.prefix + count * each
    end
    if last.count and last.count ~= "fixed" then return math.max(#data, last.offset) end
    return last.offset + last.size
end

-- The values of a field (of bytes: one text), each with its place in the data; and the bytes over.
local function values_of(row, data)
    local at, stop, found = row.offset + row.prefix, #data, {}
    if not row.count or row.count == "fixed" then stop = row.offset + row.size end
    local size = row.bytes and stop - at or row.count and row.width or row.size
    while size > 0 and at + size <= stop do
        local value = row.bytes and data:sub(at + 1, at + size) or number_at(row, size, data, at)
        table.insert(found, { at = at, size = size, value = value })
        at = at + size
    end
    return found, math.max(0, stop - at)
end

local function bits_of(row, value)
    local set = {}
    if row.bytes or #row.bits == 0 or value < row.low or value > row.high then return "" end
    for _, bit in ipairs(row.bits) do
        if band(value, bit.mask) == bit.mask then table.insert(set, bit.name) end
    end
    return format(" (%s)", #set > 0 and table.concat(set, " ") or row.none)
end

local function in_words(row, values)
    local words = {}
    for i, one in ipairs(values) do
        local name = row.names and row.names[one.value]
        words[i] = (row.bytes and hex(one.value) or format("%.0f", one.value))
            .. (name and format(" (%s)", name) or "") .. bits_of(row, one.value)
    end
    return table.concat(words, " ")
end

local function is_strange(row, value)
    if row.bytes then return #row.raw > 0 and value ~= row.raw end
    return row.names and not row.names[value] or value < row.low or value > row.high
        or row.flags > 0 and band(value, row.flags) ~= value
end

local function out_of_range(rows, data) -- the first such field, and its values
    for _, row in ipairs(rows) do
        local values, over = values_of(row, data)
        for _, one in ipairs(values) do
            if is_strange(row, one.value) then return row, values end
        end
        if over > 0 then return row, values end
    end
end

-- What a frame is, in words: who is meant, its name, its values.
local function words_of(item)
    local layout, bytes, words = item.layout, item.bytes, { item.name }
    local to = #bytes >= layout.head and part_of(layout, "address")
    if to then
        local over = 2 ^ (to.width > 0 and to.width or 8 * to.size)
        table.insert(words, 1, format("@%.0f", (read(to, bytes) - to.plus) % over))
    end
    local data = bytes:sub(layout.head + 1, #bytes - layout.tail)
    for _, row in ipairs(item.rows or {}) do
        if #row.raw == 0 then
            table.insert(words, row.name .. "=" .. in_words(row, values_of(row, data)))
        end
    end
    return table.concat(words, " ")
end

-- Judging one frame: whole, or cut short.

local function unused(id)
    return format("no instruction has ID %.0f, used are %s", id, GRAMMAR.used)
end

local function cut_short(item, bytes, size)
    local layout, spec, begun = item.layout, item.spec, #bytes >= item.layout.head
    if not spec and begun and not layout.check then return "UNKNOWN_ID", unused(item.id) end
    local name = spec and spec.name .. ": " or ""
    if begun and item.length and layout.tail == 0 then
        return "TOO_FEW", format("%s%s announced, %d came", name,
            counted(item.length, "data byte"), #bytes - layout.head)
    end
    local of = spec and size > #bytes and " of " .. counted(size, "byte") or ""
    return "TOO_FEW", format("%s%s%s came", name, counted(#bytes, "byte"), of)
end

local function fault(item, bytes)
    local layout, spec = item.layout, item.spec
    local data, least = bytes:sub(layout.head + 1, #bytes - layout.tail), layout.head + layout.tail
    if #bytes < least then data = bytes:sub(layout.head + 1) end
    local due = spec and measured(spec.fields, data)
    local size = least + (item.length or due or 0)
    item.cut = #bytes < size
    if item.cut then return cut_short(item, bytes, size) end
    local wrong = wrong_constant(layout, bytes)
    if wrong then return "BAD_SYNC", wrong end
    wrong, item.check_good = wrong_check(layout, bytes)
    if wrong then return "BAD_CHECKSUM", wrong end
    local to = part_of(layout, "address")
    item.all = to and item.address == to.broadcast
    item.alone = to and item.address >= to.low and item.address <= to.high
    if to and not item.all and not item.alone then
        return "OTHER_ADDRESS", format("%s is %.0f, allowed are %s: it is for no device", to.name,
            item.address, to.allowed)
    end
    if not spec then return "UNKNOWN_ID", unused(item.id) end
    if #data ~= due then
        return #data < due and "TOO_FEW" or "TOO_MANY", format(
            GRAMMAR.plain and "%s takes %s, the header says %d" or "%s takes %s, %d came",
            spec.name, counted(due, "data byte"), #data)
    end
    local row, values = out_of_range(spec.fields, data)
    if not row then return "VALID" end
    for code, name in pairs(GRAMMAR.codes) do
        if name == row.code then item.code = code end
    end
    local place = GRAMMAR.plain and format(" (frame %s, byte %d)", hex(bytes), 1 + row.offset)
    return "BAD_DATA", format("%s.%s is %s, allowed are %s%s", spec.name,
        row.name ~= "" and row.name or "constant", in_words(row, values), row.allowed, place or "")
end

-- The layout of frames without the check, which is all that stands behind the data of the others.
local UNCHECKED = { head = GRAMMAR.frame.head, tail = 0, parts = {},
    first = GRAMMAR.frame.check and GRAMMAR.frame.check.first }
for _, part in ipairs(GRAMMAR.frame.parts) do
    if part.role ~= "check" then table.insert(UNCHECKED.parts, part) end
end

local function judge(item, bytes)
    local layout = GRAMMAR.frame
    item.bytes, item.layout, item.name = bytes, layout, "incomplete frame"
    if #bytes >= layout.head then
        item.id = value_of(layout, "id", bytes) or 0
        item.spec = GRAMMAR.instructions[item.id]
        if item.spec and item.spec.unchecked then layout, item.layout = UNCHECKED, UNCHECKED end
        item.name = item.spec and item.spec.name or format("unused %.0f", item.id)
        item.address = value_of(layout, "address", bytes)
        item.length = value_of(layout, "length", bytes)
    end
    local outcome, reason = fault(item, bytes)
    local row, valid = GRAMMAR.outcomes[outcome], outcome == "VALID"
    item.kind, item.outcome, item.reason = item.cut and "truncated" or "instruction", row[1], reason
    if valid or outcome == "BAD_DATA" then item.rows = item.spec.fields end
    item.words = words_of(item)
    if item.length and not item.rows then
        local size = counted(item.length, "data byte")
        local came = #bytes - layout.head - layout.tail
        item.words = item.words .. (item.cut and format(", %d of %s", came, size) or ", " .. size)
    end
    item.silent = item.cut and layout.check or not row[3] or valid and not item.spec.answer
        or item.address and not item.alone
    item.judgement = not item.silent and (item.code or row[2]) or nil
    local form = valid and (#(item.spec.answer or {}) > 0 and GRAMMAR.reply or GRAMMAR.ack)
    if form and not part_of(form, "code") then item.judgement = nil end
    if reason then
        local code = item.judgement and CODES and CODES[item.judgement]
        item.info = format("%s: %s%s", item.words, code and code .. ", " or "", reason)
    end
end

-- Responses: laid out as the request asks, or as an error is.

local function names_of(code)
    if not code then return "answer", true end
    if not GRAMMAR.flags or code == 0 then
        return GRAMMAR.codes[code] or format("unused %.0f", code), GRAMMAR.codes[code]
    end
    local names, known = {}, true
    for place = 0, 31 do
        if math.floor(code / 2 ^ place) % 2 == 1 then
            known = known and GRAMMAR.codes[2 ^ place]
            table.insert(names, GRAMMAR.codes[2 ^ place])
        end
    end
    return table.concat(names, " "), known
end

local UNUSED = "it has an unused code"

-- What keeps bytes from being a right answer laid out so, and whether they are laid out so at all.
local function unlike(item, layout, rows, asked)
    local bytes = item.bytes
    if #bytes < layout.head + layout.tail then return "the bytes are not an answer" end
    for _, part in ipairs(layout.parts) do
        local most = part.width > 0 and 2 ^ part.width or 256 ^ part.size
        local own = asked and part.same ~= "" and asked.parts[part.same]
        if own and read(part, bytes) ~= (own + part.plus) % most then
            return format("%s is %.0f, right is %.0f", part.name, read(part, bytes),
                (own + part.plus) % most)
        end
    end
    local data = bytes:sub(layout.head + 1, #bytes - layout.tail)
    local length = value_of(layout, "length", bytes)
    if length and length ~= #data or not layout.has_data and not length and #data > 0 then
        return "the bytes are not an answer"
    end
    local wrong = wrong_constant(layout, bytes)
    if wrong then return wrong end
    local _, known = names_of(value_of(layout, "code", bytes))
    if not known then return UNUSED, true end
    wrong, item.check_good = wrong_check(layout, bytes, asked and asked.covered)
    if wrong and (asked or not layout.check.asked) then return wrong, true end
    local due = rows and measured(rows, data)
    if due and due ~= #data then
        return format("it has %s, %d are due", counted(#data, "data byte"), due), true
    end
    item.rows, item.layout = rows or {}, layout
end

local function answer(bytes, asked)
    local item = { bytes = bytes, kind = "response", layout = GRAMMAR.reply, name = "answer" }
    local spec = asked and asked.spec
    local rows = spec and spec.answer
    local usual = (not asked or rows and #rows > 0) and GRAMMAR.reply or GRAMMAR.ack
    local reason, near = unlike(item, usual, rows or asked and {}, asked)
    if near then item.layout = usual end
    for _, layout in ipairs(reason and GRAMMAR.errors or {}) do
        local error, nearer = unlike(item, layout, {}, asked)
        if not error then reason = nil break end
        if nearer and not near then item.layout, reason, near = layout, error, true end
    end
    item.unused = reason == UNUSED
    if not reason or item.unused then
        item.code = value_of(item.layout, "code", bytes)
        item.name = names_of(item.code)
    end
    item.reason = not item.unused and reason or nil
    item.words = words_of(item)
    item.info = item.reason and item.words .. ": " .. item.reason
    return item
end

local function is_right(item)
    return not item.reason and not item.unused
end

local function agrees(asked, item) -- whether a conforming device may answer so
    if not is_right(item) then return false end
    if asked.judgement and item.code == asked.judgement then return true end
    if GRAMMAR.plain then return false end
    local meant, some = {}, false
    for code, outcomes in pairs(GRAMMAR.meanings) do
        local tells = item.code == code
            or GRAMMAR.flags and code > 0 and band(item.code or 0, code) == code
        for _, outcome in ipairs(tells and outcomes or {}) do meant[outcome], some = true, true end
    end
    if not item.code then meant, some = { valid = true }, true end
    if not some then return true end
    if asked.outcome == "valid" then return not meant.valid or not asked.silent end
    return meant[asked.outcome] or false
end

-- The first pass. Packets come in order: frames are put together, over packets too, and responses
-- are paired with them. What it finds stays in `shown`, by packet, for every later look.

local OTHERS = -1 -- the address of every device that was not addressed yet
local now -- what depends on the packets before; waiting[first] to waiting[last] have no response
local shown -- packet number -> list of items; an item's own list are its expert infos

local function note(item)
    item.number, item.t = now.number, now.t
    table.insert(shown[now.number], item)
    return item
end

local function warn(item, word, words)
    table.insert(item, { X[word], words })
end

local function garbage(item, reason)
    item.kind, item.words = "garbage", "garbage"
    item.reason, item.info = reason, "garbage: " .. reason
    warn(item, "garbage", "Garbage: " .. reason)
end

local function next_waiting() -- the oldest, which waits no more
    local frame = now.waiting[now.first]
    now.waiting[now.first], now.first = nil, now.first + 1
    return frame
end

local function unanswered()
    warn(next_waiting(), "unanswered", "No response")
end

local function set_state(address, state)
    now.state = state
    if address then now.states[address] = state end
end

-- The new state after what an answer to the newest request reports of it.
local function take_reports(frame, item)
    if item.reason or item.unused or frame.sequence ~= now.sequence - 1 then return end
    local address, new, some = frame.address, {}, false
    local old = address and (now.states[address] or now.states[OTHERS]) or now.state
    local data = item.bytes:sub(item.layout.head + 1, #item.bytes - item.layout.tail)
    for variable, value in pairs(old) do new[variable] = value end
    for _, row in ipairs(item.rows or {}) do
        local how = row.reports
        local value = how and values_of(row, data)[1].value
        if how and how.words then
            value = how.words[value]
        elseif how then
            value = (value - how.plus) / how.factor
            if value % 1 ~= 0 or value < how.low or value > how.high then value = nil end
        end
        if value then new[how.variable], some = value, true end
    end
    if some then set_state(address, new) end
end

local function pair(frame, item)
    take_reports(frame, item)
    local latency = item.t - frame.t
    local rest = math.fmod(latency, 1e9)
    frame.response_in, item.response_to = item.number, frame.number
    item.latency = NSTime.new((latency - rest) / 1e9, rest)
    item.agrees = agrees(frame, item)
    item.info = item.words .. " to " .. (#(item.rows or {}) > 0 and frame.name or frame.words)
    if item.reason then
        item.info = item.info .. ": " .. item.reason
    elseif not item.agrees then
        item.judgement = frame.judgement
        local due = frame.judgement and names_of(frame.judgement)
        item.info = item.info .. (due and ", expected is " .. due or "")
        warn(item, "disagreeing", "The device says " .. item.info)
    end
    if latency > GRAMMAR.answer_deadline * MS then
        warn(item, "late", format("After %.1f ms, allowed are %g", latency / MS,
            GRAMMAR.answer_deadline))
    end
end

-- Pair the frame with a response that came before its end, or let it wait for one: a tap may be
-- late, or the device's time-out the shorter one. A packet tells only when its last byte came.
local function await(frame, begun)
    local early, item
    repeat
        early = table.remove(now.early, 1)
        item = early and early.t + protocol.prefs.skew * US > begun and answer(early.bytes, frame)
    until not early or item and (GRAMMAR.plain or is_right(item))
    if early then
        early.reason, early.info = nil, nil -- those of a response to nothing
        for key, value in pairs(item) do early[key] = value end
        return pair(frame, early)
    end
    local longest = GRAMMAR.answer_longest + (frame.cut and GRAMMAR.truncation_longest or 0)
    local last = now.waiting[now.last]
    frame.expires = frame.t + longest * MS
    if last then -- responses come in order: none is given up before
        frame.expires = math.max(frame.expires, last.expires)
    end
    now.last = now.last + 1
    now.waiting[now.last] = frame
end

local function new_value(old, set, values) -- false: not known
    if type(set) ~= "table" then return set end
    local place, factor, plus, low, high = (table.unpack or unpack)(set)
    local value = values[place]
    if place == 0 then return old and math.min(math.max(old * factor + plus, low), high) end
    if set.words then return set.words[value] or false end
    return value and value * factor or false
end

local function changed(state, frame)
    local new, values = {}, {}
    for i, row in ipairs(frame.reason and {} or frame.rows) do
        local data = frame.bytes:sub(frame.layout.head + 1, #frame.bytes - frame.layout.tail)
        values[i] = not row.bytes and not row.count and values_of(row, data)[1].value or false
    end
    for variable, value in pairs(state) do new[variable] = value end
    for variable, set in pairs(frame.reason and GRAMMAR.on_fault or frame.spec.sets) do
        new[variable] = new_value(state[variable], set, values)
    end
    return new
end

local function change_state(frame)
    local states, address = now.states, frame.address
    if not address then
        now.state = changed(now.state, frame)
    elseif frame.all then
        for one, state in pairs(states) do states[one] = changed(state, frame) end
        now.state = states[OTHERS]
    else
        now.state = states[address] or states[OTHERS]
        if frame.alone then
            set_state(address, changed(now.state, frame))
        end
    end
    frame.state = now.state
end

-- End the open frame, a list of its pieces; the last of them becomes the item for the whole.
local function ended(lost)
    local open = now.open
    local frame, single = open[#open], #open == 1
    now.open = nil
    for i = 1, #open - 1 do open[i].goes_on_in = frame.number end
    if lost then return garbage(frame, lost) end
    judge(frame, open.data)
    frame.sequence, now.sequence = now.sequence, now.sequence + 1
    if frame.reason then warn(frame, frame.cut and "truncated" or "faulty", frame.reason) end
    if not single then frame.whole, frame.begins_in = true, open[1].number end
    now.cut = frame.cut and frame
    change_state(frame)
    frame.parts, frame.covered = {}, covered(frame.layout, open.data)
    for _, part in ipairs(frame.cut and {} or frame.layout.parts) do
        frame.parts[part.name] = part.size <= WIDEST and read(part, open.data) or nil
    end
    if frame.silent then return end
    local pauses = (single and #open.data - 1 or 0) * protocol.prefs.truncation_timeout * US
    await(frame, open[1].t - pauses)
end

local function size_at(bytes, at) -- of the frame that begins there
    if not GRAMMAR.plain then return #bytes end -- a packet holds one
    return 1 + value_of(GRAMMAR.frame, "length", bytes:sub(at, at))
end

local function host(bytes)
    local at = 1
    now.heard = true
    while at <= #bytes do
        local open = now.open or { data = "", size = size_at(bytes, at) }
        local stop = math.min(#bytes, at + open.size - #open.data - 1)
        local place = #open == 0 and "beginning" or "part"
        table.insert(open, note({ at = at - 1, size = stop - at + 1,
            words = format("%s of a frame of %d bytes", place, open.size) }))
        open.data, now.open = open.data .. bytes:sub(at, stop), open
        if #open.data == open.size then ended() end
        at = stop + 1
    end
end

-- Bytes as the answer to the one of the waiting requests that they answer; and which one that is.
local function answered(bytes)
    local waiting, first = now.waiting, now.waiting[now.first]
    if GRAMMAR.plain then
        local after, byte = waiting[now.first + 1], bytes:byte()
        if after and byte ~= first.judgement and byte == after.judgement
            and (first.cut or now.t - first.t > GRAMMAR.answer_deadline * MS) then
            unanswered() -- the first may have gone unanswered
        end
        return answer(bytes, waiting[now.first]), next_waiting()
    end
    -- The first to which they are a right answer. Where they are that to several it is the first
    -- after the last pause: a host that pauses without an answer and asks again has given up.
    local right, place, before, paused
    for i = now.first, now.last do
        local asked = waiting[i]
        paused = paused or before and asked.t - before >= GRAMMAR.gives_up * US
        before = asked.t
        if not right or paused then
            local item = answer(bytes, asked)
            if is_right(item) then right, place, paused = item, i, false end
        end
    end
    while place and now.first < place do unanswered() end
    return right or answer(bytes, first), next_waiting()
end

local function device(bytes, stray)
    local size = GRAMMAR.plain and 1 or math.max(1, #bytes)
    for at = 1, #bytes, size do
        local piece, item, frame = bytes:sub(at, at + size - 1)
        if now.waiting[now.first] and not stray then
            item, frame = answered(piece)
        else
            item = answer(piece)
        end
        item.at, item.size, item.known = at - 1, size, stray or now.heard
        note(item)
        if frame then
            pair(frame, item)
        elseif not stray then
            table.insert(now.early, item)
        end
    end
end

local function learn(event, bytes)
    local open, timeout = now.open, protocol.prefs.truncation_timeout * US
    local over = open and (event == 3 or now.t >= open[#open].t + timeout)
    if over then ended() end
    if now.cut and (over or event == 3) then
        note({ words = "cut short: " .. now.cut.words, cut_short = now.cut.number })
        now.cut = nil
    end
    while now.waiting[now.first] and now.waiting[now.first].expires <= now.t do unanswered() end
    if event == 1 then
        host(bytes)
    elseif event == 2 or event == 4 then -- what stands at the end of data answers nothing
        device(bytes, event == 4)
    elseif event == 3 and #bytes > 0 then
        garbage(note({ at = 0, size = #bytes }), "they belong to no frame")
    elseif event == 5 or event == 10 then -- bytes were lost, by the capture or by the port
        if now.open then ended("bytes were lost in mid-frame") end
        now.waiting, now.first, now.last, now.early = {}, 1, 0, {}
    end
end

function protocol.init()
    shown, now = {}, { state = GRAMMAR.power_on, states = { [OTHERS] = GRAMMAR.power_on },
        sequence = 0, heard = false, early = {}, waiting = {}, first = 1, last = 0 }
end

-- Showing what was found.

local function at_rest(state)
    local all = GRAMMAR.at_rest.all
    for name, value in pairs(GRAMMAR.at_rest.values) do
        if (state[name] == value) ~= all then return not all end
    end
    return all
end

local function show_state(tree, state)
    local words, branch = {}, tree:add("State after it"):set_generated()
    for _, row in ipairs(GRAMMAR.state) do
        local value = state[row.name]
        local number = type(value) == "number"
        local word = value or row.name .. " not known"
        table.insert(words, number and format("%s %.0f", row.name, value) or word)
        if value then
            branch:add(row.field, number and Int64.new(value) or value):set_generated()
        end
    end
    local moving = GRAMMAR.at_rest and not at_rest(state)
    if GRAMMAR.at_rest then branch:add(MOVING.field, moving):set_generated() end
    branch:append_text(": " .. table.concat(words, ", ") .. (moving and ", moving" or ""))
end

local function add(tree, row, range)
    local plain = row.bytes or row.order ~= "little"
    return (plain and tree.add or tree.add_le)(tree, row.field, range), plain
end

local function show_frame(tree, item, range)
    local bytes, layout = item.bytes, item.layout
    local size = #bytes - layout.head - layout.tail
    if size < 0 then return tree:add(DATA.field, range) end
    for _, part in ipairs(layout.parts) do
        add(tree, part, range(place_of(part, bytes), part.size))
    end
    if size == 0 then return end
    if not item.rows or #item.rows == 0 then
        return tree:add(DATA.field, range(layout.head, size))
    end
    local data = bytes:sub(layout.head + 1, layout.head + size)
    for _, row in ipairs(item.rows) do
        for _, one in ipairs((values_of(row, data))) do
            local place = range(layout.head + one.at, one.size)
            local branch, plain = add(tree, row, place)
            branch:append_text(bits_of(row, one.value))
            for _, bit in ipairs(row.bytes and {} or row.bits) do
                (plain and branch.add or branch.add_le)(branch, bit.field, place)
            end
        end
    end
end

local function show(tree, item, payload)
    local range = item.whole and ByteArray.new(item.bytes, true):tvb("Frame")()
        or item.size and payload(item.at, item.size)
    tree = range and tree:add(protocol, range, GRAMMAR.title .. ": " .. item.words)
        or tree:add(protocol, item.words)
    if item.layout then
        show_frame(tree, item, range)
    elseif range then
        tree:add(DATA.field, range)
    end
    for _, row in ipairs(GENERATED) do
        local value = item[row.word]
        if value ~= nil then tree:add(row.field, value):set_generated() end
    end
    if item.unused then tree:add_proto_expert_info(X.unused, "Unused response") end
    if item.reason and item.kind == "response" then
        tree:add_proto_expert_info(X.damaged, item.reason)
    end
    for _, row in ipairs(item) do tree:add_proto_expert_info(row[1], row[2]) end
    if item.known and not item.response_to then
        tree:add_proto_expert_info(X.unsolicited, "It responds to no instruction")
    end
    if item.state and #GRAMMAR.state > 0 then show_state(tree, item.state) end
end

-- The packet: 12 bytes of the link type (time, event, modem lines), then the bytes of the line.

local HEADER, MOST_WORDS = 12, 8 -- of the items the info column names at most so many
local link_types = DissectorTable.get("wtap_encap")
local RTAC_SERIAL = (wtap_encaps or wtap).RTAC_SERIAL
local rtac_serial = link_types:get_dissector(RTAC_SERIAL)

function protocol.dissector(buffer, pinfo, tree)
    if not protocol.prefs.take or buffer:len() < HEADER then
        return rtac_serial:call(buffer, pinfo, tree)
    end
    rtac_serial:call(buffer(0, HEADER):tvb(), pinfo, tree)
    local payload = buffer:len() > HEADER and buffer(HEADER)
    if not pinfo.visited then
        now.t = math.floor(pinfo.rel_ts * 1e9 + 0.5) -- exact to the ns for weeks; abs_ts is not
        now.number, shown[pinfo.number] = pinfo.number, {}
        learn(buffer(8, 1):uint(), payload and payload:raw() or "")
    elseif now.open then
        ended() -- the file is over
    end
    local items, words = shown[pinfo.number] or {}, {}
    for i, item in ipairs(items) do
        show(tree, item, payload)
        words[i] = i <= MOST_WORDS and (item.info or item.words) or nil
    end
    if #items > MOST_WORDS then table.insert(words, format("and %d more", #items - MOST_WORDS)) end
    if #items > 0 then
        local from, to = "host", "device"
        if items[1].kind == "response" then from, to = to, from end
        pinfo.cols.src, pinfo.cols.dst, pinfo.cols.protocol = from, to, GRAMMAR.title
        pinfo.cols.info = table.concat(words, "; ")
    end
    return buffer:len()
end

link_types:set(RTAC_SERIAL, protocol)
