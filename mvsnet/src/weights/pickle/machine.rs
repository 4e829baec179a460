//! The instructions that pickles of weights are made of.

use std::collections::{BTreeMap, HashMap};
use std::rc::Rc;

use super::value::{Arena, Global, Storage, TensorRef, Value};
use super::{Pickle, PickleError};

/// The stack machine that a pickle is a program of.
pub(super) struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    instruction_at: usize,
    stack: Vec<Value>,
    /// Heights of the stack at each mark; values below the last are out of reach.
    marks: Vec<usize>,
    memo: HashMap<u64, Value>,
    storages: BTreeMap<Rc<str>, Storage>,
    arena: Arena,
}

impl<'a> Machine<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            at: 0,
            instruction_at: 0,
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
            storages: BTreeMap::new(),
            arena: Arena::default(),
        }
    }

    /// What was built, when this is its root.
    pub(super) fn finished(self, root: Value) -> Pickle {
        let Self { at, storages, arena, .. } = self;
        Pickle { root, storages, bytes: at, arena }
    }

    /// Carries out one instruction; the root at the last one.
    pub(super) fn step(&mut self) -> Result<Option<Value>, PickleError> {
        self.instruction_at = self.at;
        let opcode = self.unsigned(1)? as u8;
        match opcode {
            0x80 => drop(self.unsigned(1)?), // PROTO
            0x95 => drop(self.unsigned(8)?), // FRAME
            b'.' => return self.pop().map(Some),
            b'(' => self.marks.push(self.stack.len()),
            b'}' => self.push_dict(),
            b']' => self.push_list(Vec::new()),
            b')' => self.push_tuple(Vec::new()),
            b'N' => self.stack.push(Value::None),
            0x88 => self.stack.push(Value::Bool(true)),
            0x89 => self.stack.push(Value::Bool(false)),
            b'K' => {
                let value = self.unsigned(1)?;
                self.stack.push(Value::Int(value as i128));
            }
            b'M' => {
                let value = self.unsigned(2)?;
                self.stack.push(Value::Int(value as i128));
            }
            b'J' => {
                let value = self.unsigned(4)? as u32 as i32;
                self.stack.push(Value::Int(value as i128));
            }
            0x8a => self.long()?,
            b'G' => {
                self.unsigned(8)?;
                self.stack.push(Value::Float);
            }
            0x8c => self.string(1)?,
            b'X' => self.string(4)?,
            b'q' => self.memoize(1)?,
            b'r' => self.memoize(4)?,
            0x94 => self.keep(self.memo.len() as u64)?,
            b'h' => self.recall(1)?,
            b'j' => self.recall(4)?,
            b't' => {
                let items = self.pop_to_mark()?;
                self.push_tuple(items);
            }
            0x85..=0x87 => {
                let mut items = Vec::new();
                for _ in 0..=(opcode - 0x85) {
                    items.insert(0, self.pop()?);
                }
                self.push_tuple(items);
            }
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.append(items)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.insert(vec![key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.insert(items)?;
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push_global(&module, &name)?;
            }
            0x93 => match (self.pop()?, self.pop()?) {
                (Value::Str(name), Value::Str(module)) => self.push_global(&module, &name)?,
                _ => return Err(self.malformed("the name of a class is no string")),
            },
            b'Q' => self.persistent_id()?,
            b'R' => self.reduce()?,
            // Attributes of an OrderedDict (`_metadata`); no value here has attributes.
            b'b' => match (self.pop()?, self.stack.last()) {
                (_, Some(Value::Dict(_))) => {}
                _ => return Err(self.malformed("attributes for what is no dictionary")),
            },
            opcode => return Err(PickleError::UnknownInstruction { opcode, at: self.instruction_at }),
        }
        Ok(None)
    }

    fn malformed(&self, what: &'static str) -> PickleError {
        PickleError::Malformed { at: self.instruction_at, what }
    }

    fn slice(&mut self, len: usize) -> Result<&[u8], PickleError> {
        let end = self.at.checked_add(len).filter(|end| *end <= self.bytes.len());
        let end = end.ok_or(PickleError::Truncated { at: self.bytes.len() })?;
        let slice = &self.bytes[self.at..end];
        self.at = end;
        Ok(slice)
    }

    /// A number of at most eight bytes, little endian.
    fn unsigned(&mut self, width: usize) -> Result<u64, PickleError> {
        Ok(self.slice(width)?.iter().rev().fold(0, |number, byte| number << 8 | *byte as u64))
    }

    fn line(&mut self) -> Result<String, PickleError> {
        let len = self.bytes[self.at..].iter().position(|byte| *byte == b'\n');
        let len = len.ok_or(PickleError::Truncated { at: self.bytes.len() })?;
        let line = String::from_utf8_lossy(self.slice(len)?).into_owned();
        self.at += 1;
        Ok(line)
    }

    /// A string after its length of so many bytes.
    fn string(&mut self, width: usize) -> Result<(), PickleError> {
        let len = usize::try_from(self.unsigned(width)?).unwrap_or(usize::MAX);
        let text = str::from_utf8(self.slice(len)?).map(Rc::from);
        let text = text.map_err(|_| self.malformed("a string is not UTF-8"))?;
        self.stack.push(Value::Str(text));
        Ok(())
    }

    /// LONG1: two's complement of up to 255 bytes, little endian; sixteen are plenty.
    fn long(&mut self) -> Result<(), PickleError> {
        let len = self.unsigned(1)?;
        if len > 16 {
            return Err(self.malformed("an integer of more than 16 bytes"));
        }
        let digits = self.slice(len as usize)?;
        let fill = if digits.last().is_some_and(|byte| byte & 0x80 != 0) { 0xff } else { 0 };
        let mut bytes = [fill; 16];
        bytes[..digits.len()].copy_from_slice(digits);
        self.stack.push(Value::Int(i128::from_le_bytes(bytes)));
        Ok(())
    }

    fn pop(&mut self) -> Result<Value, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() <= floor {
            return Err(self.malformed("the stack is empty"));
        }
        self.stack.pop().ok_or_else(|| self.malformed("the stack is empty"))
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Value>, PickleError> {
        let mark = self.marks.pop().ok_or_else(|| self.malformed("there is no mark"))?;
        Ok(self.stack.split_off(mark))
    }

    fn push_dict(&mut self) {
        self.stack.push(Value::Dict(self.arena.dicts.len()));
        self.arena.dicts.push(Vec::new());
    }

    fn push_list(&mut self, items: Vec<Value>) {
        self.stack.push(Value::List(self.arena.sequences.len()));
        self.arena.sequences.push(items);
    }

    fn push_tuple(&mut self, items: Vec<Value>) {
        self.stack.push(Value::Tuple(self.arena.sequences.len()));
        self.arena.sequences.push(items);
    }

    fn push_global(&mut self, module: &str, name: &str) -> Result<(), PickleError> {
        let global = Global::named(module, name).ok_or_else(|| PickleError::Forbidden {
            name: format!("{module}.{name}"),
            at: self.instruction_at,
        })?;
        self.stack.push(Value::Global(global));
        Ok(())
    }

    /// Keeps the topmost value under a key of so many bytes.
    fn memoize(&mut self, width: usize) -> Result<(), PickleError> {
        let key = self.unsigned(width)?;
        self.keep(key)
    }

    fn keep(&mut self, key: u64) -> Result<(), PickleError> {
        let value = self.stack.last().cloned().ok_or_else(|| self.malformed("the stack is empty"))?;
        self.memo.insert(key, value);
        Ok(())
    }

    /// Puts the value that was kept under a key of so many bytes on the stack.
    fn recall(&mut self, width: usize) -> Result<(), PickleError> {
        let key = self.unsigned(width)?;
        let value = self.memo.get(&key).cloned();
        let value = value.ok_or_else(|| self.malformed("a value is recalled that was never kept"))?;
        self.stack.push(value);
        Ok(())
    }

    fn append(&mut self, items: Vec<Value>) -> Result<(), PickleError> {
        match self.stack.last() {
            Some(Value::List(index)) => self.arena.sequences[*index].extend(items),
            _ => return Err(self.malformed("items for what is no list")),
        }
        Ok(())
    }

    fn insert(&mut self, items: Vec<Value>) -> Result<(), PickleError> {
        let Some(Value::Dict(index)) = self.stack.last() else {
            return Err(self.malformed("entries for what is no dictionary"));
        };
        if !items.len().is_multiple_of(2) {
            return Err(self.malformed("a key without a value"));
        }
        let mut items = items.into_iter();
        while let (Some(key), Some(value)) = (items.next(), items.next()) {
            self.arena.dicts[*index].push((key, value));
        }
        Ok(())
    }

    /// `("storage", type, key, location, length)`, and a view in old files, which must be none.
    fn persistent_id(&mut self) -> Result<(), PickleError> {
        let Value::Tuple(index) = self.pop()? else {
            return Err(self.malformed("a reference to a storage is no tuple"));
        };
        match self.arena.sequences[index].as_slice() {
            [
                Value::Str(tag),
                Value::Global(Global::Storage(element)),
                Value::Str(key),
                _,
                len,
                view @ ..,
            ] if &**tag == "storage" && matches!(view, [] | [Value::None]) => {
                let len = len.as_size().ok_or_else(|| self.malformed("the length of a storage"))?;
                let storage = Storage { element: *element, len };
                if *self.storages.entry(key.clone()).or_insert(storage) != storage {
                    return Err(self.malformed("two descriptions of one storage"));
                }
                self.stack.push(Value::Storage(key.clone()));
                Ok(())
            }
            _ => Err(self.malformed("a reference to what is no storage")),
        }
    }

    /// A call of one of the allowed names.
    fn reduce(&mut self) -> Result<(), PickleError> {
        let (arguments, callee) = (self.pop()?, self.pop()?);
        let (Value::Tuple(index), Value::Global(global)) = (arguments, callee) else {
            return Err(self.malformed("a call of what is no function"));
        };
        let arguments = &self.arena.sequences[index];
        match (global, arguments.as_slice()) {
            (Global::Dict, [] | [Value::Global(Global::Dict)]) => self.push_dict(),
            (Global::RebuildParameter, [tensor @ Value::Tensor(_), ..])
            | (Global::Size, [tensor @ Value::Tuple(_)]) => {
                let value = tensor.clone();
                self.stack.push(value);
            }
            (
                Global::RebuildTensor,
                [Value::Storage(storage), offset, Value::Tuple(shape), Value::Tuple(strides), ..],
            ) => {
                let sizes = |index: &usize| self.arena.sequences[*index].iter().map(Value::as_size).collect();
                let tensor = offset.as_size().zip(sizes(shape)).zip(sizes(strides));
                let ((offset, shape), strides) =
                    tensor.ok_or_else(|| self.malformed("the size of a tensor"))?;
                let storage = storage.clone();
                self.stack.push(Value::Tensor(Rc::new(TensorRef { storage, offset, shape, strides })));
            }
            _ => return Err(self.malformed("a call with unknown arguments")),
        }
        Ok(())
    }
}
